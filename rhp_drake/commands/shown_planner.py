"""The kinodynamic RRT as `rhp plan` shows it: how its search comes on, and its plan."""

from collections.abc import Callable
from dataclasses import dataclass
import time
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rhp_drake import typed_yaml
from rhp_drake.commands.tree_drawing import TreeDrawing
from rhp_drake.planning import kinodynamic_rrt
from rhp_drake.planning.search import Growth, Plan
from rhp_drake.push_model.transition import PushModel
from rhp_drake.scenario import Scenario
from rhp_drake.task import GOAL_RADIUS, Action, object_positions


@dataclass
class ShownPlanner:
    """Plans as `kinodynamic_rrt.plan` does, and shows how.

    Attributes:
        scenario: Goes to the record.
        console: Where to say how the search comes on.
        drawing: Where to draw the tree, None for nowhere.
        on_plan: Called with the record of the first plan, ready for JSON.
        num_begun: How many searches began.
        num_ended: How many came to an end.
    """

    scenario: Scenario
    console: Console
    drawing: TreeDrawing | None
    on_plan: Callable[[dict[str, Any]], None]
    num_begun: int = 0
    num_ended: int = 0

    def __call__(
        self,
        push_model: PushModel,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        *,
        time_limit: float,
    ) -> Plan:
        """Plans; see `open_loop.Planner`."""
        growth: Growth | None = None
        nearest = _nearest(state[None], goals)
        begin = time.perf_counter()
        self.num_begun += 1
        if self.drawing is not None:
            self.drawing.begin_search()

        # Not more often: it takes time from the search.
        with self.console.status("Planning", refresh_per_second=4) as status:

            def on_growth(newest: Growth) -> None:
                nonlocal growth, nearest
                growth = newest
                nearest = min(nearest, _nearest(growth.children, goals))
                seconds = time.perf_counter() - begin
                status.update(_progress(growth, nearest, seconds))
                if self.drawing is not None:
                    self.drawing.add(growth)

            found = kinodynamic_rrt.plan(
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
            self.on_plan(_make_record(self.scenario, found, goals, growth))
            if found.actions is not None:
                self.console.print(_make_table(found.actions, found.states, goals))
        elif found.actions is not None:
            self.console.print(f"A new plan of {len(found.actions)} actions.")
        self.num_ended += 1
        return found


def _nearest(states: np.ndarray, goals: np.ndarray) -> float:
    """How near the target has come to its goal with all obstacles in their regions.

    Args:
        states: Shape (N, 3 + 3 m).
        goals: Shape (m, 2).

    Returns:
        The least distance, m; inf if no state has all obstacles there.
    """
    distances = np.linalg.norm(object_positions(states) - goals, axis=-1)
    inside = (distances[:, 1:] <= GOAL_RADIUS).all(axis=1)
    return float(distances[inside, 0].min(initial=np.inf))


def _progress(growth: Growth, nearest: float, seconds: float) -> str:
    """How far a search has come, in one line."""
    trees = "1 tree" if growth.num_trees == 1 else f"{growth.num_trees} trees"
    reached = f"target at best {100 * nearest:.1f} cm from its goal"
    if growth.plan_length is not None:
        reached = f"a plan of {growth.plan_length} actions"
    return (
        f"Planning: {growth.num_transitions} pushes "
        f"({growth.num_transitions / seconds:.0f}/s), {trees}, {reached}"
    )


def _make_table(actions: np.ndarray, states: np.ndarray, goals: np.ndarray) -> Table:
    """A plan's actions (L,) and states (L + 1, 3 + 3 m), a row an action."""
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
    scenario: Scenario, found: Plan, goals: np.ndarray, growth: Growth | None
) -> dict[str, Any]:
    """Everything about a plan, ready for JSON.

    The same scenario gives the same record but for `times`, as long as the search
    does not reach its limit of time.
    """
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
