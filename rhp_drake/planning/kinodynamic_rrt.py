"""KDP: a kinodynamic RRT over statically stable states (section IV-A of the paper).

After Haustein et al. (ICRA 2015): nodes are states in which everything rests, edges
are actions of the push model, and whatever the physics does in between is taken as
it comes.  Where this one differs: the tree grows towards places *for the target*,
and "near" means near to having pushed it there: the hand counts by its pose relative
to the node's own target object.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
import time
from typing import Final

import numpy as np

from rhp_drake.planning.search import Search, SearchRecord
from rhp_drake.push_model.transition import PushModel
from rhp_drake.task import (
    GOAL_RADIUS,
    HAND_ACTIONS,
    MAX_ACTIONS,
    NUM_ACTIONS,
    ROTATION,
    TRANSLATION,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    allowed_actions,
    goals_reached,
    object_positions,
    objects_fallen,
)

# How often the place to grow to is the goal rather than a random one.
_GOAL_BIAS: Final = 0.75
# Weights in the distance, in actions: of the hand's way to its pushing pose, of each
# obstacle's displacement, and of the actions already taken, against the target's way.
# Each tree draws its own between these bounds.
_LIGHTEST: Final = np.array([0.4, 0.5, 0.0])
_HEAVIEST: Final = np.array([1.0, 1.5, 0.4])
# Simulated actions after which a tree is given up for a fresh one: the time to a plan
# is heavy-tailed, and another tree's luck beats this one's patience.
_RESTART: Final = 1500
# m: an obstacle this far out of its region is as good as lost.
_OBSTACLE_LIMIT: Final = 1.5 * GOAL_RADIUS
# m: states closer than this in every coordinate are the same to the planner...
_DUPLICATE_DISTANCE: Final = 0.012
# ...with this many metres to a radian.
_ANGLE_LENGTH: Final = 0.1
# m: the hand's opening.
_OPENING: Final = 0.10
# rad: how far from the hand's heading it can still push an object in its opening.
_WIDEST_PUSH: Final = math.radians(100)


@dataclass(frozen=True)
class Plan:
    """What the planner found.

    Attributes:
        actions: Shape (L,); None if no plan was found within the limits.
        states: s_0 ... s_L, shape (L + 1, 3 + 3 m); s_0 alone without a plan.
        search: All that was simulated, the pruned children included.
        seconds: Time it took.
    """

    actions: np.ndarray | None
    states: np.ndarray
    search: Search
    seconds: float


@dataclass(frozen=True)
class Growth:
    """How far a search has come, told after each node that it expands.

    Attributes:
        num_transitions: Actions simulated so far, in all trees.
        num_trees: Trees begun so far.
        num_nodes: Of the present tree.
        nearest: The least distance from the target to its goal in any tree's state
            that has every obstacle inside its region, m; inf if there is none.
        source: The node that was expanded, shape (3 + 3 m,).
        children: The nodes that the tree got from it, shape (k, 3 + 3 m).
    """

    num_transitions: int
    num_trees: int
    num_nodes: int
    nearest: float
    source: np.ndarray
    children: np.ndarray


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _hand_actions(
    hands: np.ndarray, targets: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Actions it takes the hands, about, to a pose that pushes to `place`.

    Such a pose has the target in the hand's opening, which may point anywhere but
    back: the palm pushes forward, a finger sideways.  Outside, the hand must face
    the target to let it in.
    """
    way, approach = place - targets, targets - hands[:, :2]
    distance = np.linalg.norm(approach, axis=1)
    turn = np.abs(_wrap(np.arctan2(way[:, 1], way[:, 0]) - hands[:, 2]))
    misalignment = np.abs(
        _wrap(np.arctan2(approach[:, 1], approach[:, 0]) - hands[:, 2])
    )
    outside = np.clip(distance / _OPENING - 0.5, 0, 1)
    return (
        distance / TRANSLATION
        + np.maximum(turn - _WIDEST_PUSH, 0) / ROTATION
        + outside * misalignment / ROTATION
    )


class _Tree:
    """A growing tree: its nodes, and which of them were not expanded yet."""

    def __init__(
        self, state: np.ndarray, goals: np.ndarray, generator: np.random.Generator
    ) -> None:
        self.goals = goals
        self._weights = generator.uniform(_LIGHTEST, _HEAVIEST)
        capacity = _RESTART + NUM_ACTIONS + 1
        self.states = np.empty((capacity, len(state)))
        self._keys = np.empty((capacity, len(state)))
        self._costs = np.empty(capacity)
        self._open = np.zeros(capacity, dtype=bool)
        # Of each node: the node and action it came from, and how many actions ago
        # the tree began.
        self._parents: list[int] = []
        self._actions: list[int] = []
        self._depths: list[int] = []
        # The transition of the search that each node is the end of, -1 for the root.
        self.transitions: list[int] = []
        self.add(state, -1, -1, -1)

    @property
    def num_nodes(self) -> int:
        """The rows of `states` in use."""
        return len(self._parents)

    def add(self, state: np.ndarray, parent: int, action: int, transition: int) -> bool:
        """Adds a node, unless it is too deep or the tree has nearly the same state."""
        size = len(self._parents)
        depth = self._depths[parent] + 1 if parent >= 0 else 0
        if depth > MAX_ACTIONS:
            return False
        key = state.copy()
        key[2::3] *= _ANGLE_LENGTH
        distances = np.abs(self._keys[:size] - key).max(axis=1)
        if size and distances.min() < _DUPLICATE_DISTANCE:
            return False
        moved = np.linalg.norm(object_positions(state)[1:] - self.goals[1:], axis=1)
        self.states[size] = state
        self._keys[size] = key
        self._costs[size] = (
            self._weights[1] * moved.sum() / TRANSLATION + self._weights[2] * depth
        )
        self._open[size] = True
        self._parents.append(parent)
        self._actions.append(action)
        self.transitions.append(transition)
        self._depths.append(depth)
        return True

    def pop_nearest(self, place: np.ndarray) -> int | None:
        """Takes the open node nearest to having the target at `place`."""
        candidates = np.flatnonzero(self._open)
        if not len(candidates):
            return None
        states = self.states[candidates]
        targets = states[:, 3:5]
        distances = (
            np.linalg.norm(place - targets, axis=1) / TRANSLATION
            + self._weights[0] * _hand_actions(states[:, :3], targets, place)
            + self._costs[candidates]
        )
        node = int(candidates[distances.argmin()])
        self._open[node] = False
        return node

    def plan_to_newest(self) -> tuple[np.ndarray, np.ndarray]:
        """The actions (L,) and states (L + 1, 3 + 3 m) to the newest node."""
        path = [len(self._parents) - 1]
        while self._parents[path[-1]] >= 0:
            path.append(self._parents[path[-1]])
        path.reverse()
        return np.array([self._actions[n] for n in path[1:]], int), self.states[path]


def plan(
    push_model: PushModel,
    state: np.ndarray,
    goals: np.ndarray,
    generator: np.random.Generator,
    *,
    max_transitions: int = 1_000_000,
    time_limit: float = float("inf"),
    action_set: np.ndarray = HAND_ACTIONS,
    on_growth: Callable[[Growth], None] | None = None,
) -> Plan:
    """Grows a tree from `state` until a goal state is in it.

    Args:
        push_model: What the edges are simulated in.
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        generator: Draws the places that the tree grows to.
        max_transitions: Limit of simulated actions.
        time_limit: Limit of computation, s.
        action_set: The actions to plan with.
        on_growth: Called after each node's expansion; it changes nothing.
    """
    begin = time.perf_counter()
    tree = _Tree(state, goals, generator)
    record = SearchRecord(len(state))
    found = (np.empty(0, int), state[None]) if goals_reached(state, goals) else None
    restart_at = _RESTART
    num_trees, nearest = 1, _nearest(state[None], goals)
    while found is None and record.num_transitions < max_transitions:
        if time.perf_counter() - begin > time_limit:
            break
        place = (
            goals[0]
            if generator.random() < _GOAL_BIAS
            else generator.uniform(WORKSPACE_LOWER, WORKSPACE_UPPER)
        )
        node = tree.pop_nearest(place)
        if node is None or record.num_transitions >= restart_at:
            tree = _Tree(state, goals, generator)
            restart_at = record.num_transitions + _RESTART
            num_trees += 1
            continue
        source = tree.states[node].copy()
        actions = action_set[allowed_actions(source, action_set)]
        if not len(actions):
            if node == 0:
                break
            continue
        children = push_model.step(np.repeat(source[None], len(actions), 0), actions)
        indices = record.add(source, actions, children, tree.transitions[node])
        before = tree.num_nodes
        found = _grow(tree, node, actions, children, indices)
        if on_growth is not None:
            added = tree.states[before : tree.num_nodes].copy()
            nearest = min(nearest, _nearest(added, goals))
            on_growth(
                Growth(
                    record.num_transitions,
                    num_trees,
                    tree.num_nodes,
                    nearest,
                    source,
                    added,
                )
            )
    seconds = time.perf_counter() - begin
    if found is None:
        return Plan(None, state[None], record.search(), seconds)
    return Plan(*found, record.search(), seconds)


def _nearest(states: np.ndarray, goals: np.ndarray) -> float:
    """`Growth.nearest` of states (N, 3 + 3 m)."""
    distances = np.linalg.norm(object_positions(states) - goals, axis=-1)
    inside = (distances[:, 1:] <= GOAL_RADIUS).all(axis=1)
    return float(distances[inside, 0].min(initial=np.inf))


def _grow(
    tree: _Tree,
    node: int,
    actions: np.ndarray,
    children: np.ndarray,
    indices: np.ndarray,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Adds a node's children, and returns the plan if one of them is a goal."""
    moved = object_positions(children)[:, 1:] - tree.goals[1:]
    lost = (np.linalg.norm(moved, axis=-1) > _OBSTACLE_LIMIT).any(axis=1)
    lost |= objects_fallen(children)
    for i in np.flatnonzero(~lost):
        child = children[i]
        added = tree.add(child, node, int(actions[i]), int(indices[i]))
        if added and goals_reached(child, tree.goals):
            return tree.plan_to_newest()
    return None
