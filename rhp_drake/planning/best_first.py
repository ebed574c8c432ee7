"""A plan by best-first search in which the Q-network proposes the actions.

The values tell how many actions are left after an action, so a state and action is
worth simulating in the order of actions already taken plus actions left: A*, with a
heuristic that is learned and therefore neither admissible nor exact (Learning Heuristic
Search via Imitation, Bhardwaj, Choudhury and Scherer 2017, has the idea for motion
planning).  It needs no random draws.
"""

import heapq
import math
import time
from typing import Final, NamedTuple

import numpy as np

from rhp_drake.planning.receding_horizon import (
    TransitionFunction,
    ValueFunction,
    masked_values,
)
from rhp_drake.planning.search import Nodes, Plan, SearchRecord, hopeless
from rhp_drake.task import (
    HAND_ACTIONS,
    MAX_ACTIONS,
    goals_reached,
)

# How much an action already taken counts against one that the network says is left:
# less than one, because to trust the network leads to a plan sooner (weighted A*).
_WEIGHT_OF_DEPTH: Final = 0.5
# Pairs of state and action that are simulated together.
_BATCH_SIZE: Final = 6


def plan_best_first(
    push_model: TransitionFunction,
    value_function: ValueFunction,
    state: np.ndarray,
    goals: np.ndarray,
    *,
    max_transitions: int = 6000,
    time_limit: float = float("inf"),
) -> Plan:
    """Simulates the most promising actions first until a goal state is met.

    Args:
        push_model: What is simulated in.
        value_function: Says what is promising.
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        max_transitions: Limit of simulated actions.
        time_limit: Limit of computation, s.
    """
    begin = time.perf_counter()
    record = SearchRecord(len(state))
    nodes = Nodes(state)
    queue: list[_Edge] = []
    goal = 0 if goals_reached(state, goals) else None
    _propose(queue, value_function, nodes, [0], goals)
    while goal is None and queue and record.num_transitions < max_transitions:
        if time.perf_counter() - begin > time_limit:
            break
        batch = [heapq.heappop(queue) for _ in range(min(_BATCH_SIZE, len(queue)))]
        parents = np.array([edge.node for edge in batch])
        actions = np.array([edge.action for edge in batch])
        sources = nodes.states[parents]
        children = push_model.step(sources, actions)
        indices = record.add(sources, actions, children, nodes.transitions[parents])
        new = []
        for i in np.flatnonzero(~hopeless(children, goals, state)):
            # A goal state may be nearly the same as one that just misses the goal.
            reached = goals_reached(children[i], goals)
            if nodes.has_near(children[i]) and not reached:
                continue
            node = nodes.add(
                children[i], int(parents[i]), int(actions[i]), int(indices[i])
            )
            if reached:
                goal = node
                break
            if nodes.depths[node] < MAX_ACTIONS:
                new.append(node)
        if new:
            _propose(queue, value_function, nodes, new, goals)
    seconds = time.perf_counter() - begin
    if goal is None:
        return Plan(None, state[None], record.search(), seconds, math.nan)
    return Plan(*nodes.path(goal), record.search(), seconds, seconds)


class _Edge(NamedTuple):
    """An action not yet simulated, in the order of `cost`; equals first come first."""

    cost: float
    node: int
    action: int


def _propose(
    queue: list[_Edge],
    value_function: ValueFunction,
    nodes: Nodes,
    new: list[int],
    goals: np.ndarray,
) -> None:
    """Queues the actions that the nodes `new` allow."""
    values = masked_values(value_function, nodes.states[new], goals)
    costs = _WEIGHT_OF_DEPTH * nodes.depths[new][:, None] - values
    for node, of_node in zip(new, costs, strict=True):
        for action, cost in zip(HAND_ACTIONS, of_node, strict=True):
            if np.isfinite(cost):
                heapq.heappush(queue, _Edge(float(cost), node, int(action)))
