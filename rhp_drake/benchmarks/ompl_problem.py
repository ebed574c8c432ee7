"""A task as OMPL asks about it: states to sample, actions to simulate, the goal."""

import math
from typing import Any, Final

import numpy as np

from rhp_drake.planning.search import hopeless
from rhp_drake.push_model.transition import PushModel
from rhp_drake.task import (
    GOAL_RADIUS,
    HAND_ACTIONS,
    MAX_ACTIONS,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    TaskInstance,
    allowed_actions,
    object_positions,
)

# The node number of states that are no node: samples, and what must not be reached.
NO_NODE: Final = -1


class Problem:
    """The task in the coordinates that OMPL sees, and what was simulated of it.

    A state of OMPL's is compound: hand's position, hand's heading, target's position,
    each obstacle's position, and the number of the node, which does not count in the
    distance.  The node has the true state, with all angles and the turns of the wrist.
    """

    def __init__(
        self, push_model: PushModel, task: TaskInstance, generator: np.random.Generator
    ) -> None:
        self._push_model = push_model
        self.task = task
        self._generator = generator
        # Of each node: the state, how many actions ago the task began, and, once it was
        # expanded, the node that each valid action leads to.
        self._states: list[np.ndarray] = []
        self._depths: list[int] = []
        self._children: list[dict[int, int] | None] = []
        # Reading floats from lists is quicker than from arrays.
        self._coordinates: list[tuple[list[float], list[list[float]]]] = []
        self._goals: list[list[float]] = task.goals.tolist()
        self._add(task.initial_state, 0)
        self.num_transitions = 0

    def node(self, state: Any) -> int:
        """The node that OMPL's state is, or `NO_NODE`."""
        return int(state[2 + self.task.num_objects][0])

    def write(self, state: Any, node: int) -> None:
        """Makes OMPL's state the node."""
        self._write(state, *self._coordinates[node], node)

    def write_no_node(self, state: Any) -> None:
        """Makes OMPL's state one that must not be reached."""
        state[2 + self.task.num_objects][0] = NO_NODE

    def _write(
        self,
        state: Any,
        hand: list[float],
        positions: list[list[float]],
        node: int,
    ) -> None:
        state[0][0], state[0][1] = hand[:2]
        state[1].value = math.remainder(hand[2], math.tau)
        for i, (x, y) in enumerate(positions):
            part = state[2 + i]
            part[0], part[1] = x, y
        state[2 + len(positions)][0] = node

    def sample(self, state: Any, *, goal: bool) -> None:
        """Makes OMPL's state a place to grow to.

        The target is anywhere in its goal region or in the workspace, the hand holds it
        at any heading, and the obstacles are in their regions.
        """
        draws = self._generator.random(2 * self.task.num_objects + 1).tolist()
        positions = []
        for (x, y), u, v in zip(self._goals, draws[:-1:2], draws[1::2], strict=True):
            radius, angle = GOAL_RADIUS * math.sqrt(u), math.tau * v
            positions.append(
                [x + radius * math.cos(angle), y + radius * math.sin(angle)]
            )
        if not goal:
            size = WORKSPACE_UPPER - WORKSPACE_LOWER
            positions[0] = (WORKSPACE_LOWER + draws[:2] * size).tolist()
        self._write(state, [*positions[0], math.tau * draws[-1]], positions, NO_NODE)

    def goal_distance(self, state: Any) -> float:
        """The largest distance of an object from its goal, m."""
        return max(
            math.hypot(state[2 + i][0] - x, state[2 + i][1] - y)
            for i, (x, y) in enumerate(self._goals)
        )

    def children(self, node: int) -> dict[int, int]:
        """The nodes that each action leads to, as far as it is allowed and valid.

        All of a node's actions are simulated in one batch, the first time.
        """
        children = self._children[node]
        if children is not None:
            return children
        children = self._children[node] = {}
        state = self._states[node]
        controls = np.flatnonzero(allowed_actions(state))
        depth = self._depths[node] + 1
        if depth > MAX_ACTIONS:
            return children
        results = self._push_model.step(
            np.repeat(state[None], len(controls), axis=0), HAND_ACTIONS[controls]
        )
        self.num_transitions += len(controls)
        for i in np.flatnonzero(~hopeless(results, self.task.goals, self._states[0])):
            children[int(controls[i])] = len(self._states)
            self._add(results[i], depth)
        return children

    def _add(self, state: np.ndarray, depth: int) -> None:
        self._states.append(state)
        self._depths.append(depth)
        self._children.append(None)
        self._coordinates.append((state[:3].tolist(), object_positions(state).tolist()))
