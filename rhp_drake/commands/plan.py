"""`rhp plan`: one plan of the kinodynamic RRT, shown as it is found, then executed."""

from dataclasses import dataclass
import json
import os
from pathlib import Path
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rhp_drake.commands import task_run
from rhp_drake.planning.policy_config import CheckedPlanConfig, OpenLoopConfig

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console
    from rich.table import Table

    from rhp_drake.commands.tree_drawing import TreeDrawing
    from rhp_drake.planning.search import Growth, Plan
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.scenario import Scenario
    from rhp_drake.systems.receding_horizon_planner import DecisionRecord


def plan(
    scenario: task_run.ScenarioFile,
    *,
    name: task_run.ScenarioName = None,
    seed: task_run.Seed = None,
    scenario_text: task_run.ScenarioText = None,
    time_limit: Annotated[
        float | None,
        typer.Option(
            help="Of each search, s; by default what the scenario's policy says if "
            "it is of this kind, else 120."
        ),
    ] = None,
    checked: Annotated[
        bool,
        typer.Option(
            "--checked/--open-loop",
            help="Look before each action, and plan anew if the scene is not as the "
            "plan expects it; or execute the plan blindly.",
        ),
    ] = False,
    execute: Annotated[bool, typer.Option(help="Execute the plan.")] = True,
    realtime: task_run.Realtime = True,
    meshcat: Annotated[
        bool, typer.Option(help="Show tree and run in a browser, and record them.")
    ] = True,
    out: task_run.Out = None,
) -> None:
    """Plans one task with the kinodynamic RRT, and executes the plan.

    Writes plan.json; run.json, if the plan is to be executed; and recording.html,
    with Meshcat.  The exit status is 0 if the plan succeeded or, with
    --no-execute, was found; 1 if not, 2 for bad input, 130 after Ctrl-C.
    """
    from rhp_drake.scenario import load_scenario

    config = CheckedPlanConfig if checked else OpenLoopConfig
    limit = {} if time_limit is None else {"time_limit": time_limit}
    overrides = [
        f"seed: {seed}" if seed is not None else "",
        scenario_text or "",
        # Last: whatever policy the scenario names, this command plans.
        f"policy: !{config.__name__} {json.dumps(limit)}",
    ]
    title, loaded = load_scenario(scenario, name, [text for text in overrides if text])
    folder = out or task_run.default_folder()
    raise typer.Exit(_plan(title, loaded, execute, realtime, meshcat, folder))


def _plan(
    title: str,
    scenario: "Scenario",
    execute: bool,
    realtime: bool,
    use_meshcat: bool,
    folder: Path,
) -> int:
    """Plans, shows, executes, and writes the results; returns the exit status."""
    from rhp_drake.commands.tree_drawing import TreeDrawing
    from rhp_drake.files import make_folder
    from rhp_drake.planning.policy_config import MakePolicy

    meshcat = task_run.start_meshcat(scenario) if use_meshcat else None
    drawing = TreeDrawing(meshcat) if meshcat is not None else None
    console = task_run.make_console()
    planner = _ShownPlanner(scenario, console, drawing, folder)
    policy = MakePolicy(
        scenario.policy,
        len(scenario.station.objects),
        num_threads=os.cpu_count() or 1,
        planner=planner,
    )
    simulator = task_run.make_simulator(scenario, policy, meshcat, realtime)
    make_folder(folder)
    task_run.say_title(console, title, scenario, meshcat)
    shown = 0

    def on_decision(record: "DecisionRecord") -> None:
        nonlocal shown
        if planner.num_begun == shown:
            return
        shown = planner.num_begun
        if drawing is not None:
            drawing.show_from(record.time)
        # Reality need not be caught up with after a long search.
        simulator.ResetStatistics()
        if not execute:
            raise _NotExecutedError

    # The planning is part of the loop, from the state that the robot measures.  So
    # `rhp run` on run.json finds the same plan.
    with task_run.recorded(meshcat, folder):
        try:
            run = task_run.run_task(simulator, scenario, console, on_decision)
        except _NotExecutedError:
            run = None
        # No decision has shown a search that failed or was interrupted.
        if drawing is not None and planner.num_begun > shown:
            drawing.show_from(simulator.get_context().get_time())
    if run is None:
        console.print(f"Results: {folder}")
        return 0
    if planner.num_begun == 0:
        console.print("There is no plan: no search began.")
    elif planner.num_ended == 0:
        console.print("There is no plan: the search did not come to its end.")
    if execute:
        task_run.write_run(run, scenario, folder)
    task_run.say_outcome(console, run, folder)
    return task_run.exit_status(run.outcome)


class _NotExecutedError(Exception):
    """The first plan is there, and nobody wants more."""


@dataclass
class _ShownPlanner:
    """Plans as `kinodynamic_rrt.plan` does, and shows how; writes the first plan down.

    Attributes:
        scenario: Goes to plan.json.
        console: Where to say how the search comes on.
        drawing: Where to draw the tree, None for nowhere.
        folder: Of plan.json.
        num_begun: How many searches began.
        num_ended: How many came to an end.
    """

    scenario: "Scenario"
    console: "Console"
    drawing: "TreeDrawing | None"
    folder: Path
    num_begun: int = 0
    num_ended: int = 0

    def __call__(
        self,
        push_model: "PushModel",
        state: "np.ndarray",
        goals: "np.ndarray",
        generator: "np.random.Generator",
        *,
        time_limit: float,
    ) -> "Plan":
        """Plans; see `open_loop.Planner`."""
        from rhp_drake.planning.kinodynamic_rrt import plan as grow_tree

        growth: Growth | None = None
        nearest = _nearest(state[None], goals)
        begin = time.perf_counter()
        self.num_begun += 1
        if self.drawing is not None:
            self.drawing.begin_search()

        # Not more often: it takes time from the search.
        with self.console.status("Planning", refresh_per_second=4) as status:

            def on_growth(newest: "Growth") -> None:
                nonlocal growth, nearest
                growth = newest
                nearest = min(nearest, _nearest(growth.children, goals))
                seconds = time.perf_counter() - begin
                status.update(_progress(growth, nearest, seconds))
                if self.drawing is not None:
                    self.drawing.add(growth)

            found = grow_tree(
                push_model,
                state,
                goals,
                generator,
                time_limit=time_limit,
                on_growth=on_growth,
            )
        if self.drawing is not None:
            self.drawing.draw()
        if growth is not None:
            self.console.print(_progress(growth, nearest, found.seconds))
        if self.num_ended == 0:
            self._write(found, goals, growth)
            if found.actions is not None:
                self.console.print(_make_table(found.actions, found.states, goals))
        elif found.actions is not None:
            self.console.print(f"A new plan of {len(found.actions)} actions.")
        self.num_ended += 1
        return found

    def _write(
        self, found: "Plan", goals: "np.ndarray", growth: "Growth | None"
    ) -> None:
        from rhp_drake.run_record import write_record

        write_record(
            self.folder / "plan.json",
            _make_record(self.scenario, found, goals, growth),
        )


def _nearest(states: "np.ndarray", goals: "np.ndarray") -> float:
    """How near the target has come to its goal with all obstacles in their regions.

    Args:
        states: Shape (N, 3 + 3 m).
        goals: Shape (m, 2).

    Returns:
        The least distance, m; inf if no state has all obstacles there.
    """
    import numpy as np

    from rhp_drake.task import GOAL_RADIUS, object_positions

    distances = np.linalg.norm(object_positions(states) - goals, axis=-1)
    inside = (distances[:, 1:] <= GOAL_RADIUS).all(axis=1)
    return float(distances[inside, 0].min(initial=np.inf))


def _progress(growth: "Growth", nearest: float, seconds: float) -> str:
    """How far a search has come, in one line."""
    trees = "1 tree" if growth.num_trees == 1 else f"{growth.num_trees} trees"
    reached = f"target at best {100 * nearest:.1f} cm from its goal"
    if growth.plan_length is not None:
        reached = f"a plan of {growth.plan_length} actions"
    return (
        f"Planning: {growth.num_transitions} pushes "
        f"({growth.num_transitions / seconds:.0f}/s), {trees}, {reached}"
    )


def _make_table(
    actions: "np.ndarray", states: "np.ndarray", goals: "np.ndarray"
) -> "Table":
    """A plan's actions (L,) and states (L + 1, 3 + 3 m), a row an action."""
    import numpy as np
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.task import Action, object_positions

    table = Table(title="What the plan expects after each action", box=SIMPLE_HEAD)
    table.add_column("#", justify="right")
    table.add_column("action")
    table.add_column("target to\ngoal, cm", justify="right")
    table.add_column("farthest obstacle\ndisplaced, cm", justify="right")
    distances = np.linalg.norm(object_positions(states) - goals, axis=-1)
    rows = zip(actions, distances[1:], strict=True)
    for number, (action, distance) in enumerate(rows, 1):
        table.add_row(
            str(number),
            Action(action).name.lower(),
            f"{100 * distance[0]:.1f}",
            f"{100 * distance[1:].max(initial=0):.1f}",
        )
    return table


def _make_record(
    scenario: "Scenario", found: "Plan", goals: "np.ndarray", growth: "Growth | None"
) -> dict[str, Any]:
    """Everything about a plan, ready for JSON.

    The same scenario gives the same record but for `times`, as long as the search
    does not reach its limit of time.
    """
    from rhp_drake import typed_yaml
    from rhp_drake.task import Action

    actions = None
    if found.actions is not None:
        actions = [Action(action).name.lower() for action in found.actions]
    return {
        "scenario": typed_yaml.expand(scenario),
        "seed": scenario.seed,
        "goals": goals.tolist(),
        "actions": actions,
        "states": found.states.tolist(),
        "search": {
            "num_transitions": growth.num_transitions if growth else 0,
            "num_trees": growth.num_trees if growth else 1,
            "num_nodes": growth.num_nodes if growth else 1,
        },
        "times": {"seconds": found.seconds},
    }
