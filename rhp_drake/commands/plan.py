"""`rhp plan`: one plan of the kinodynamic RRT, shown as it is found, then executed."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rhp_drake.commands import task_run
from rhp_drake.planning.policy_config import CheckedPlanConfig, OpenLoopConfig

# Drake is imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
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
    from rhp_drake.run_record import check_simulated
    from rhp_drake.scenario import load_scenario

    check_simulated(scenario)
    config = CheckedPlanConfig if checked else OpenLoopConfig
    limit = {} if time_limit is None else {"time_limit": time_limit}
    overrides = [
        f"seed: {seed}" if seed is not None else "",
        scenario_text or "",
        # Last: whatever policy the scenario names, this command plans.
        f"policy: !{config.__name__} {json.dumps(limit)}",
    ]
    title, loaded = load_scenario(scenario, name, [text for text in overrides if text])
    raise typer.Exit(_plan(title, loaded, execute, realtime, meshcat, out))


def _plan(
    title: str,
    scenario: "Scenario",
    execute: bool,
    realtime: bool,
    use_meshcat: bool,
    out: Path | None,
) -> int:
    """Plans, shows, executes, and writes the results; returns the exit status."""
    from rhp_drake.commands.shown_planner import ShownPlanner
    from rhp_drake.commands.tree_drawing import TreeDrawing
    from rhp_drake.planning.policy_config import MakePolicy
    from rhp_drake.run_record import write_record

    meshcat = task_run.start_meshcat(scenario) if use_meshcat else None
    drawing = TreeDrawing(meshcat) if meshcat is not None else None
    console = task_run.make_console()

    def on_plan(record: dict[str, Any]) -> None:
        write_record(folder / task_run.PLAN_FILE, record)

    planner = ShownPlanner(scenario, console, drawing, on_plan)
    policy = MakePolicy(
        scenario.policy,
        len(scenario.station.objects),
        num_threads=os.cpu_count() or 1,
        planner=planner,
    )
    simulator = task_run.make_simulator(scenario, policy, meshcat, realtime)
    folder = task_run.start_folder(out)
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
    task_run.start_recording(meshcat)
    try:
        run = task_run.run_task(simulator, scenario, console, on_decision)
    except _NotExecutedError:
        run = None
    # No decision has shown a search that failed or was interrupted.
    if drawing is not None and planner.num_begun > shown:
        drawing.show_from(simulator.get_context().get_time())
    # What comes last, a fault for one.
    simulator.get_system().ForcedPublish(simulator.get_context())
    task_run.write_recording(meshcat, folder)
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
