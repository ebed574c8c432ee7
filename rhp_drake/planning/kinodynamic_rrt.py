"""KDP: a kinodynamic RRT over statically stable states (section IV-A of the paper).

After Haustein et al. (ICRA 2015): nodes are states in which everything rests, edges
are actions of the push model, and whatever the physics does in between is taken as
it comes.  Where this one differs: the tree grows towards places *for the target*,
and "near" means near to having pushed it there: the hand counts by its pose relative
to the node's own target object.

The first plan of an RRT has detours.  It gets shorter by growing further trees that
are cut where they can no longer beat it, and keeping the best plan (anytime RRTs,
Ferguson and Stentz 2006).
"""

from collections.abc import Callable
import math
import time
from typing import Final

import numpy as np

from rhp_drake.planning.search import Growth, Nodes, Plan, SearchRecord, hopeless
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
)

# How often the place to grow to is the goal rather than a random one.
_GOAL_BIAS: Final = 0.75
# Weights in the distance, in actions: of the hand's way to its pushing pose, of each
# obstacle's displacement, and of the actions already taken, against the target's way.
# Each tree draws its own between these bounds...
_LIGHTEST: Final = np.array([0.4, 0.5, 0.0])
_HEAVIEST: Final = np.array([1.0, 1.5, 0.4])
# ...and minds the actions already taken more when there is a plan to beat.
_LIGHTEST_TO_IMPROVE: Final = np.array([0.4, 0.5, 0.4])
_HEAVIEST_TO_IMPROVE: Final = np.array([1.0, 1.5, 1.0])
# Simulated actions after which a tree is given up for a fresh one: the time to a plan
# is heavy-tailed, and another tree's luck beats this one's patience.
_RESTART: Final = 1500
# Actions that are worth simulating for a shorter plan.  For what they bring, see
# `rhp bench planners --planners rrt,rrt_first`: the latter stops at its first plan.
IMPROVEMENT: Final = 1000
# m: the hand's opening.
_OPENING: Final = 0.10
# rad: how far from the hand's heading it can still push an object in its opening.
_WIDEST_PUSH: Final = math.radians(100)


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def actions_to_pushing_pose(
    hands: np.ndarray, targets: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Actions it takes the hands, about, to a pose that pushes to `place`.

    Such a pose has the target in the hand's opening, which may point anywhere but
    back: the palm pushes forward, a finger sideways.  Outside, the hand must face
    the target to let it in.

    Args:
        hands: Poses, shape (N, 3).
        targets: Positions of the object to push, m in W, shape (N, 2).
        place: Where to push it to, m in W, shape (2,).

    Returns:
        Shape (N,).
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


def fewest_actions_left(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """How many translations it takes at least to push the target home.

    Args:
        states: Shape (..., 3 + 3 m).
        goals: Shape (m, 2).

    Returns:
        Whole numbers of shape (...).  (A turn may move a target at a finger's tip a
        little further than a translation would.)
    """
    offsets = object_positions(states)[..., 0, :] - goals[0]
    distance = np.linalg.norm(offsets, axis=-1) - GOAL_RADIUS
    return np.ceil(np.maximum(distance, 0) / TRANSLATION)


class _Tree:
    """A growing tree: its nodes, and which of them were not expanded yet.

    Args:
        state: Of its root.
        goals: Shape (m, 2).
        generator: Draws its weights.
        length_to_beat: Of the shortest plan so far; None if there is none.
    """

    def __init__(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        length_to_beat: int | None = None,
    ) -> None:
        self.goals = goals
        if length_to_beat is None:
            self._weights = generator.uniform(_LIGHTEST, _HEAVIEST)
            self._max_depth = MAX_ACTIONS
        else:
            self._weights = generator.uniform(
                _LIGHTEST_TO_IMPROVE, _HEAVIEST_TO_IMPROVE
            )
            self._max_depth = length_to_beat - 1
        capacity = _RESTART + NUM_ACTIONS + 1
        self.nodes = Nodes(state)
        self._costs = np.zeros(capacity)
        self._open = np.zeros(capacity, dtype=bool)
        self._open[0] = True

    def add(self, state: np.ndarray, parent: int, action: int, transition: int) -> bool:
        """Adds a node, unless it is too deep or the tree has nearly the same state."""
        depth = int(self.nodes.depths[parent]) + 1
        if depth + fewest_actions_left(state, self.goals) > self._max_depth:
            return False
        if self.nodes.has_near(state):
            return False
        node = self.nodes.add(state, parent, action, transition)
        moved = np.linalg.norm(object_positions(state)[1:] - self.goals[1:], axis=1)
        self._costs[node] = (
            self._weights[1] * moved.sum() / TRANSLATION + self._weights[2] * depth
        )
        self._open[node] = True
        return True

    def pop_nearest(self, place: np.ndarray) -> int | None:
        """Takes the open node nearest to having the target at `place`."""
        candidates = np.flatnonzero(self._open)
        if not len(candidates):
            return None
        states = self.nodes.states[candidates]
        targets = states[:, 3:5]
        distances = (
            np.linalg.norm(place - targets, axis=1) / TRANSLATION
            + self._weights[0] * actions_to_pushing_pose(states[:, :3], targets, place)
            + self._costs[candidates]
        )
        node = int(candidates[distances.argmin()])
        self._open[node] = False
        return node


def plan(
    push_model: PushModel,
    state: np.ndarray,
    goals: np.ndarray,
    generator: np.random.Generator,
    *,
    max_transitions: int = 1_000_000,
    improvement: int = IMPROVEMENT,
    time_limit: float = float("inf"),
    action_set: np.ndarray = HAND_ACTIONS,
    on_growth: Callable[[Growth], None] | None = None,
) -> Plan:
    """Grows a tree from `state` until a goal state is in it, then tries to do better.

    Args:
        push_model: What the edges are simulated in.
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        generator: Draws the places that the tree grows to.
        max_transitions: Limit of simulated actions.
        improvement: Actions to simulate, after a plan was found, for a shorter one.
        time_limit: Limit of computation, s.
        action_set: The actions to plan with.
        on_growth: Called after each node's expansion; it changes nothing.
    """
    begin = time.perf_counter()
    tree = _Tree(state, goals, generator)
    record = SearchRecord(len(state))
    best = (np.empty(0, int), state[None]) if goals_reached(state, goals) else None
    length_to_beat = None
    first_seconds = math.nan if best is None else 0.0
    can_grow = best is None and allowed_actions(state, action_set).any()
    restart_at, stop_at = _RESTART, max_transitions if can_grow else 0
    num_trees = 1
    while record.num_transitions < stop_at:
        if time.perf_counter() - begin > time_limit:
            break
        node = tree.pop_nearest(_draw_place(generator, goals))
        if node is None or record.num_transitions >= restart_at:
            tree = _Tree(state, goals, generator, length_to_beat)
            restart_at = record.num_transitions + _RESTART
            num_trees += 1
            continue
        num_nodes = len(tree.nodes)
        found = _expand(tree, node, push_model, action_set, record)
        if found is not None:
            if best is None:
                first_seconds = time.perf_counter() - begin
                stop_at = min(stop_at, record.num_transitions + improvement)
            best, length_to_beat = found, len(found[0])
        if on_growth is not None:
            on_growth(
                Growth(
                    record.num_transitions,
                    num_trees,
                    len(tree.nodes),
                    tree.nodes.states[node],
                    tree.nodes.states[num_nodes:],
                    length_to_beat,
                )
            )
        if found is None:
            continue
        if len(found[0]) <= fewest_actions_left(state, goals):
            break
        tree = _Tree(state, goals, generator, length_to_beat)
        restart_at = record.num_transitions + _RESTART
        num_trees += 1
    seconds = time.perf_counter() - begin
    if best is None:
        return Plan(None, state[None], record.search(), seconds, first_seconds)
    return Plan(*best, record.search(), seconds, first_seconds)


def _draw_place(generator: np.random.Generator, goals: np.ndarray) -> np.ndarray:
    """A place for the target, x and y (m), to grow to."""
    if generator.random() < _GOAL_BIAS:
        return goals[0]
    return generator.uniform(WORKSPACE_LOWER, WORKSPACE_UPPER)


def _expand(
    tree: _Tree,
    node: int,
    push_model: PushModel,
    action_set: np.ndarray,
    record: SearchRecord,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Simulates a node's actions, and adds its children up to the first goal state.

    Returns:
        The plan to that state, as `Nodes.path` has it; None if there is none.
    """
    source = tree.nodes.states[node]
    actions = action_set[allowed_actions(source, action_set)]
    if not len(actions):
        return None
    sources = np.repeat(source[None], len(actions), axis=0)
    children = push_model.step(sources, actions)
    origins = np.repeat(tree.nodes.transitions[node], len(actions))
    indices = record.add(sources, actions, children, origins)
    for i in np.flatnonzero(~hopeless(children, tree.goals, tree.nodes.states[0])):
        child = children[i]
        added = tree.add(child, node, int(actions[i]), int(indices[i]))
        if added and goals_reached(child, tree.goals):
            return tree.nodes.path(len(tree.nodes) - 1)
    return None
