"""What planners share: plans, what was simulated for them, which states are new."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhp_drake.push_model.transition import PushModel
from rhp_drake.task import (
    GOAL_RADIUS,
    MAX_ACTIONS,
    TaskInstance,
    allowed_actions,
    goals_reached,
    object_positions,
    objects_fallen,
)

# m: an obstacle that has got this much further from where it belongs than it was, or
# than its region reaches, is as good as lost.
_OBSTACLE_MARGIN: Final = 0.5 * GOAL_RADIUS
# m: states closer than this in every coordinate are the same to a planner...
_DUPLICATE_DISTANCE: Final = 0.012
# ...with this many metres to a radian.
_ANGLE_LENGTH: Final = 0.1


@dataclass(frozen=True)
class Search:
    """T simulated actions: what a planner looked at, be it good or bad.

    Attributes:
        states: Shape (T, 3 + 3 m).
        actions: Shape (T,).
        next_states: Shape (T, 3 + 3 m).
        origins: For each, which one led to its state; -1 at a root.  Shape (T,).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    origins: np.ndarray


def chain(states: np.ndarray, actions: np.ndarray) -> Search:
    """The transitions along one sequence of actions.

    Args:
        states: s_0 ... s_L, shape (L + 1, 3 + 3 m).
        actions: Shape (L,).
    """
    return Search(states[:-1], actions, states[1:], np.arange(len(actions)) - 1)


@dataclass(frozen=True)
class Plan:
    """What a planner found.

    Attributes:
        actions: Shape (L,); None if no plan was found within the limits.
        states: s_0 ... s_L, shape (L + 1, 3 + 3 m); s_0 alone without a plan.
        search: All that was simulated, the children that were dropped included.
        seconds: Time of the whole search.
        first_seconds: When the first plan was found, s after the search began; nan
            without one.
    """

    actions: np.ndarray | None
    states: np.ndarray
    search: Search
    seconds: float
    first_seconds: float


@dataclass(frozen=True)
class Growth:
    """How far a search has come, told after each node that it expands.

    Attributes:
        num_transitions: Actions simulated so far, in all trees.
        num_trees: Trees begun so far.
        num_nodes: Of the present tree.
        source: The node that was expanded, shape (3 + 3 m,).
        children: The nodes that the tree got from it, shape (k, 3 + 3 m).
        plan_length: Actions of the best plan so far; None if there is none yet.
    """

    num_transitions: int
    num_trees: int
    num_nodes: int
    source: np.ndarray
    children: np.ndarray
    plan_length: int | None


class SearchRecord:
    """Collects what is simulated."""

    def __init__(self, state_size: int) -> None:
        self._states = [np.empty((0, state_size))]
        self._actions = [np.empty(0, int)]
        self._next_states = [np.empty((0, state_size))]
        self._origins = [np.empty(0, int)]
        self.num_transitions = 0

    def add(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        next_states: np.ndarray,
        origins: np.ndarray,
    ) -> np.ndarray:
        """Adds A transitions, as `Search` describes them.

        Returns:
            Their indices, shape (A,).
        """
        self._states.append(states)
        self._actions.append(actions)
        self._next_states.append(next_states)
        self._origins.append(origins)
        first = self.num_transitions
        self.num_transitions += len(actions)
        return np.arange(first, self.num_transitions)

    def search(self) -> Search:
        """All of them, in order."""
        return Search(
            np.concatenate(self._states),
            np.concatenate(self._actions),
            np.concatenate(self._next_states),
            np.concatenate(self._origins),
        )


class Nodes:
    """The states that a search goes on from, each with the way to it.

    Attributes:
        states: Shape (N, 3 + 3 m).
        depths: How many actions each is from the root, shape (N,).
        transitions: The transition of the search record that ended there, -1 for the
            root, shape (N,).
    """

    def __init__(self, root: np.ndarray) -> None:
        self._size = 1
        self._states = root[None]
        self._keys = _key(root)[None]
        self._depths = np.zeros(1, dtype=int)
        self._parents = np.full(1, -1)
        self._actions = np.full(1, -1)
        self._transitions = np.full(1, -1)

    def __len__(self) -> int:
        return self._size

    @property
    def states(self) -> np.ndarray:  # noqa: D102
        return self._states[: self._size]

    @property
    def depths(self) -> np.ndarray:  # noqa: D102
        return self._depths[: self._size]

    @property
    def transitions(self) -> np.ndarray:  # noqa: D102
        return self._transitions[: self._size]

    def has_near(self, state: np.ndarray) -> bool:
        """Whether nearly the same state is among them."""
        distances = np.abs(self._keys[: self._size] - _key(state)).max(axis=1)
        return bool(distances.min() < _DUPLICATE_DISTANCE)

    def add(self, state: np.ndarray, parent: int, action: int, transition: int) -> int:
        """Adds a state that an action led to; returns its number."""
        node = self._size
        if node == len(self._states):
            self._make_room()
        self._states[node] = state
        self._keys[node] = _key(state)
        self._depths[node] = self._depths[parent] + 1
        self._parents[node] = parent
        self._actions[node] = action
        self._transitions[node] = transition
        self._size += 1
        return node

    def _make_room(self) -> None:
        for name in ("states", "keys", "depths", "parents", "actions", "transitions"):
            array = getattr(self, f"_{name}")
            setattr(self, f"_{name}", np.concatenate([array, np.empty_like(array)]))

    def path(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        """The actions (L,) and states (L + 1, 3 + 3 m) from the root to a node."""
        path = [node]
        while self._parents[path[-1]] >= 0:
            path.append(int(self._parents[path[-1]]))
        path.reverse()
        return self._actions[path[1:]], self._states[path]


def near_any(state: np.ndarray, states: np.ndarray) -> bool:
    """Whether a state (3 + 3 m,) is nearly one of the states (N, 3 + 3 m)."""
    distances = np.abs(_key(states) - _key(state)).max(axis=1)
    return bool((distances < _DUPLICATE_DISTANCE).any())


def _key(states: np.ndarray) -> np.ndarray:
    keys = states.copy()
    keys[..., 2::3] *= _ANGLE_LENGTH
    return keys


def hopeless(states: np.ndarray, goals: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Whether no planner should go on from the states, booleans of shape (N,).

    Args:
        states: Shape (N, 3 + 3 m).
        goals: Shape (m, 2).
        root: Where the search began, shape (3 + 3 m,): an obstacle may be lost there
            already, and has to come back.
    """
    limits = np.maximum(_obstacle_distances(root, goals), GOAL_RADIUS)
    lost = _obstacle_distances(states, goals) > limits + _OBSTACLE_MARGIN
    return lost.any(axis=-1) | objects_fallen(states)


def _obstacle_distances(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """How far obstacles are from where they belong, m, shape (..., m - 1)."""
    return np.linalg.norm(object_positions(states)[..., 1:, :] - goals[1:], axis=-1)


def leads_to_goal(
    push_model: PushModel, task: TaskInstance, actions: np.ndarray
) -> bool:
    """Whether a plan (L,) of allowed actions, not too many, solves the task."""
    if len(actions) > MAX_ACTIONS:
        return False
    state = task.initial_state
    for action in actions:
        if not allowed_actions(state, np.array([action]))[0]:
            return False
        state = push_model.step(state[None], np.array([action]))[0]
    return bool(goals_reached(state, task.goals))
