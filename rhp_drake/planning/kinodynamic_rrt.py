"""KDP: a kinodynamic RRT over statically stable states (section IV-A of the paper).

After Haustein et al. (ICRA 2015): nodes are states in which everything rests, edges
are actions of the push model, and whatever the physics does in between is taken as
it comes.  Where this one differs: the tree grows towards places *for the target*,
and "near" means near to having pushed it there: the hand counts by its pose relative
to the node's own target object.
"""

from dataclasses import dataclass
import time
from typing import Any, Final

import numpy as np

from rhp_drake.planning.policy import Decision, PolicyFailure
from rhp_drake.push_model.transition import PushModel
from rhp_drake.task import (
    GOAL_RADIUS,
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
# Weights of the distance, in actions: of the hand's way to its pushing pose, and of
# each obstacle's displacement, against the target's way.
_HAND_WEIGHT: Final = 0.4
_OBSTACLE_WEIGHT: Final = 0.5
# Weight of the actions already taken: plans get shorter, the search longer.
_DEPTH_WEIGHT: Final = 0.3
# m: an obstacle this far out of its region is as good as lost.
_OBSTACLE_LIMIT: Final = 1.5 * GOAL_RADIUS
# m (rad / 0.1): states closer than this are the same to the planner.
_DUPLICATE_DISTANCE: Final = 0.004
# m: where the hand wants H behind the target's centre.
_PUSHING_OFFSET: Final = 0.01


@dataclass(frozen=True)
class Tree:
    """All that was simulated while planning, the pruned children included.

    Attributes:
        states: States that actions were simulated from, shape (K, 3 + 3 m).
        parents: For each transition, the index of its state, shape (T,).
        actions: Shape (T,).
        next_states: Shape (T, 3 + 3 m).
    """

    states: np.ndarray
    parents: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray


@dataclass(frozen=True)
class Plan:
    """What the planner found.

    Attributes:
        actions: Shape (L,); None if no plan was found within the limits.
        states: s_0 ... s_L, shape (L + 1, 3 + 3 m); s_0 alone without a plan.
        tree: The whole search.
        seconds: Time it took.
    """

    actions: np.ndarray | None
    states: np.ndarray
    tree: Tree
    seconds: float


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _hand_actions(hands: np.ndarray, targets: np.ndarray, place: np.ndarray):
    """Actions it takes the hands, about, to a pose that pushes to `place`."""
    way = place - targets
    heading = np.arctan2(way[:, 1], way[:, 0])
    direction = np.column_stack([np.cos(heading), np.sin(heading)])
    offset = hands[:, :2] - (targets - _PUSHING_OFFSET * direction)
    turn = np.abs(_wrap(hands[:, 2] - heading))
    return np.linalg.norm(offset, axis=1) / TRANSLATION + turn / ROTATION


class _Frontier:
    """The nodes not expanded yet, as arrays that grow."""

    def __init__(self, num_objects: int, goals: np.ndarray) -> None:
        self._goals = goals
        self._states = np.empty((256, 3 + 3 * num_objects))
        self._cost = np.empty(256)
        self._open = np.zeros(256, dtype=bool)
        self._keys = np.empty((256, 3 + 3 * num_objects))
        self.size = 0

    def add(self, state: np.ndarray, depth: int) -> bool:
        """Adds a node, unless the tree has nearly the same state."""
        key = state.copy()
        key[2::3] *= 0.1
        known = self._keys[: self.size]
        if len(known) and (
            np.abs(known - key).max(axis=1).min() < _DUPLICATE_DISTANCE
        ):
            return False
        if self.size == len(self._open):
            for name in ("_states", "_cost", "_open", "_keys"):
                old = getattr(self, name)
                setattr(self, name, np.concatenate([old, np.zeros_like(old)]))
        moved = object_positions(state)[1:] - self._goals[1:]
        self._states[self.size] = state
        self._keys[self.size] = key
        self._cost[self.size] = (
            _OBSTACLE_WEIGHT * np.linalg.norm(moved, axis=1).sum() / TRANSLATION
            + _DEPTH_WEIGHT * depth
        )
        self._open[self.size] = True
        self.size += 1
        return True

    def pop_nearest(self, place: np.ndarray) -> int | None:
        """Takes the node nearest to having the target at `place`."""
        candidates = np.flatnonzero(self._open[: self.size])
        if not len(candidates):
            return None
        states = self._states[candidates]
        targets = states[:, 3:5]
        distance = (
            np.linalg.norm(place - targets, axis=1) / TRANSLATION
            + _HAND_WEIGHT * _hand_actions(states[:, :3], targets, place)
            + self._cost[candidates]
        )
        node = candidates[distance.argmin()]
        self._open[node] = False
        return int(node)

    def state(self, node: int) -> np.ndarray:
        """The state of a node."""
        return self._states[node]


def plan(
    push_model: PushModel,
    state: np.ndarray,
    goals: np.ndarray,
    generator: np.random.Generator,
    *,
    max_transitions: int = 1_000_000,
    time_limit: float = float("inf"),
) -> Plan:
    """Grows a tree from `state` until a goal state is in it.

    Args:
        push_model: What the edges are simulated in.
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        generator: Draws the places that the tree grows to.
        max_transitions: Limit of simulated actions.
        time_limit: Limit of computation, s.
    """
    begin = time.perf_counter()
    frontier = _Frontier(push_model.num_objects, goals)
    frontier.add(state, 0)
    depths = [0]
    # Of each node: the node and action it came from.
    origins: list[tuple[int, int]] = [(-1, -1)]
    expanded: list[np.ndarray] = []
    parents: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    next_states: list[np.ndarray] = []
    num_transitions = 0
    goal_node = 0 if goals_reached(state, goals) else None

    while goal_node is None and num_transitions < max_transitions:
        if time.perf_counter() - begin > time_limit:
            break
        place = (
            goals[0]
            if generator.random() < _GOAL_BIAS
            else generator.uniform(WORKSPACE_LOWER, WORKSPACE_UPPER)
        )
        node = frontier.pop_nearest(place)
        if node is None:
            break
        source = frontier.state(node).copy()
        tried = np.flatnonzero(allowed_actions(source))
        children = push_model.step(np.repeat(source[None], len(tried), 0), tried)
        expanded.append(source)
        parents.append(np.full(len(tried), len(expanded) - 1))
        actions.append(tried)
        next_states.append(children)
        num_transitions += len(tried)

        moved = object_positions(children)[:, 1:] - goals[1:]
        lost = (np.linalg.norm(moved, axis=-1) > _OBSTACLE_LIMIT).any(axis=1)
        lost |= objects_fallen(children)
        for action, child in zip(tried[~lost], children[~lost], strict=True):
            if frontier.add(child, depths[node] + 1):
                depths.append(depths[node] + 1)
                origins.append((node, int(action)))
                if goals_reached(child, goals):
                    goal_node = frontier.size - 1
                    break

    tree = Tree(
        np.array(expanded).reshape(-1, len(state)),
        np.concatenate([*parents, np.empty(0, int)]).astype(np.int32),
        np.concatenate([*actions, np.empty(0, int)]).astype(np.int8),
        np.concatenate([*next_states, np.empty((0, len(state)))]),
    )
    seconds = time.perf_counter() - begin
    if goal_node is None:
        return Plan(None, state[None], tree, seconds)
    path, chosen = [goal_node], []
    while origins[path[-1]][0] >= 0:
        node, action = origins[path[-1]]
        path.append(node)
        chosen.append(action)
    states = np.array([frontier.state(node) for node in reversed(path)])
    return Plan(np.array(chosen[::-1], dtype=int), states, tree, seconds)


class OpenLoop:
    """The policy that plans once and executes the plan blindly: KDP of Table I.

    Args:
        push_model: What it plans in.
        time_limit: Limit of computation, s.
    """

    def __init__(self, push_model: PushModel, time_limit: float = 120.0) -> None:
        self._push_model = push_model
        self._time_limit = time_limit

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The plan's next action; see `policy.Policy`.  Plans at the first call."""
        if memory is None:
            found = plan(
                self._push_model, state, goals, generator, time_limit=self._time_limit
            )
            if found.actions is None:
                raise PolicyFailure(
                    f"the planner found no plan in {found.seconds:.0f} s."
                )
            memory = tuple(found.actions)
        if not memory:
            raise PolicyFailure("the plan has ended and the goal is not reached.")
        return Decision(int(memory[0]), -float(len(memory)), memory=memory[1:])


