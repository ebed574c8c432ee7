"""Model predictive control by sampling: looking ahead without having learned.

This is what MuJoCo MPC or judo would do: the push model as the simulator, and a cost
made by hand.  A decision simulates as RHP does, n roll-outs of h actions.  What differs
is where they look and how they judge it.  RHP asks its value function; here the plan of
the last decision says where to look, and the cost how good it is there.

A *plan* is a table of shape (k, 6): how likely each action is at each of k steps.  Its
rows need not add up to one.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhp_drake.planning.kinodynamic_rrt import actions_to_pushing_pose
from rhp_drake.planning.policy import Decision, check_decidable
from rhp_drake.planning.receding_horizon import (
    TransitionFunction,
    sample_weighted,
    step_distinct,
)
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.task import (
    GOAL_RADIUS,
    NUM_ACTIONS,
    TRANSLATION,
    allowed_actions,
    goals_reached,
    object_positions,
    objects_fallen,
)

# All numbers here were tuned on validation tasks.
# Cost of an action that an object has to be pushed yet, for the target and obstacles.
_WAY_WEIGHT: Final = 1.0
_OBSTACLE_WAY_WEIGHT: Final = 2.0
# Cost of an action that the hand is away from pushing an object that has to be pushed.
# The target comes first: were they equal, the hand would stay between two such objects.
_HAND_WEIGHT: Final = 0.5
_OBSTACLE_HAND_WEIGHT: Final = 0.2
# Cost of an object off the table: more than all else adds up to.
_FALLEN_COST: Final = 1000.0
# How likely predictive sampling replaces an action of its plan.
_MUTATION: Final = 0.3
# lambda of MPPI, in units of a roll-out's cost.
_TEMPERATURE: Final = 1.0
# The part of MPPI's plan that is spread over all actions, so that none dies out.
_SMOOTHING: Final = 0.3


def hand_made_cost(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """What there is to do yet, about, in actions; 0 where all objects are home.

    For each object outside its region it counts the object's way there, and the hand's
    way to a pose that pushes it there, by weights.

    Args:
        states: Shape (N, 3 + 3 m).
        goals: Shape (m, 2).

    Returns:
        Shape (N,), at least 0.
    """
    positions = object_positions(states)
    distances = np.linalg.norm(positions - goals, axis=-1)
    ways = np.maximum(distances - GOAL_RADIUS, 0) / TRANSLATION
    cost = _FALLEN_COST * objects_fallen(states)
    for i, goal in enumerate(goals):
        hand = actions_to_pushing_pose(states[:, :3], positions[:, i], goal)
        way_weight = _OBSTACLE_WAY_WEIGHT if i else _WAY_WEIGHT
        hand_weight = _OBSTACLE_HAND_WEIGHT if i else _HAND_WEIGHT
        outside = ways[:, i] > 0
        cost += outside * (way_weight * ways[:, i] + hand_weight * hand)
    return cost


@dataclass(frozen=True)
class _RollOuts:
    """What a decision has looked at; no roll-out goes on once all have ended.

    Attributes:
        actions: Shape (n, k), k <= h; without a meaning where a roll-out has ended.
        states: Shape (n, k + 1, 3 + 3 m).
        returns: Minus the cost of each, shape (n,).
    """

    actions: np.ndarray
    states: np.ndarray
    returns: np.ndarray


def _draw_actions(
    likelihoods: np.ndarray, allowed: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Draws an allowed action for each row.

    Args:
        likelihoods: A row of a plan for each, shape (N, 6).  Where it has nothing that
            is allowed, all that is allowed is equally likely.
        allowed: Booleans of shape (N, 6), at least one a row.
        generator: Draws one number a row.
    """
    weights = np.where(allowed, likelihoods, 0.0)
    lost = ~weights.any(axis=1, keepdims=True)
    return sample_weighted(np.where(lost, allowed, weights), generator)


def _roll_out(
    push_model: TransitionFunction,
    state: np.ndarray,
    goals: np.ndarray,
    plans: np.ndarray,
    generator: np.random.Generator,
) -> _RollOuts:
    """Draws and simulates a roll-out of each plan.

    All go forward together.  A roll-out's cost is the sum over its states after each
    action.  One that reaches the goal or loses an object ends there, and its last
    state stands for those after it: the earlier the goal is reached, the better.

    Args:
        push_model: T.
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        plans: Shape (n, h, 6).
        generator: Draws the actions.
    """
    n, horizon, _ = plans.shape
    states = np.repeat(state[None], n, axis=0)
    path, actions = [states], []
    returns = np.zeros(n)
    alive = np.ones(n, dtype=bool)
    for depth in range(horizon):
        drawn = _draw_actions(plans[:, depth], allowed_actions(states), generator)
        states = states.copy()
        states[alive] = step_distinct(push_model, states[alive], drawn[alive])
        actions.append(drawn)
        path.append(states)
        returns -= hand_made_cost(states, goals)
        alive &= ~objects_fallen(states) & ~goals_reached(states, goals)
        if not alive.any():
            break
    return _RollOuts(np.stack(actions, axis=1), np.stack(path, axis=1), returns)


@dataclass(frozen=True)
class SamplingMpc(ABC):
    """What the two planners share.

    The memory is the plan from the next decision on, its last step left open.  Where
    the push model refuses the state, that plan decides without looking ahead.

    Attributes:
        push_model: T, what the roll-outs are simulated in.
        num_roll_outs: n.
        horizon: h.
    """

    push_model: TransitionFunction
    num_roll_outs: int
    horizon: int

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The first action of a better plan; see `policy.Policy`."""
        allowed = check_decidable(state)
        plan = np.full((self.horizon, NUM_ACTIONS), 1 / NUM_ACTIONS)
        if memory is not None:
            plan[: len(memory)] = memory
        plans = self._plans_to_try(plan)
        try:
            roll_outs = _roll_out(self.push_model, state, goals, plans, generator)
        except PushModelError:
            # As in `RecedingHorizon`: to wait would not help.
            (action,) = _draw_actions(plan[:1], allowed[None], generator)
            return Decision(int(action), np.nan, memory=plan[1:])
        return self._choose(roll_outs)

    @abstractmethod
    def _plans_to_try(self, plan: np.ndarray) -> np.ndarray:
        """What to draw the roll-outs from, shape (n, h, 6), given a plan (h, 6)."""

    @abstractmethod
    def _choose(self, roll_outs: _RollOuts) -> Decision:
        """The decision that the roll-outs suggest."""


class PredictiveSampling(SamplingMpc):
    """Predictive sampling (Howell et al. 2022, arXiv:2212.00541).

    It tries the plan of the last decision and n - 1 mutations of it, in which each
    action is replaced by a random one now and then.  The cheapest is the new plan.
    """

    def _plans_to_try(self, plan: np.ndarray) -> np.ndarray:
        mutated = (1 - _MUTATION) * plan + _MUTATION / NUM_ACTIONS
        plans = np.repeat(mutated[None], self.num_roll_outs, axis=0)
        plans[0] = plan
        return plans

    def _choose(self, roll_outs: _RollOuts) -> Decision:
        best = roll_outs.returns.argmax()
        actions = roll_outs.actions[best]
        return Decision(
            int(actions[0]),
            float(roll_outs.returns[best]),
            roll_outs.states,
            roll_outs.returns,
            np.eye(NUM_ACTIONS)[actions[1:]],
        )


class Mppi(SamplingMpc):
    """Model predictive path integral control (Williams et al. 2017), made discrete.

    The plan is the distribution that the roll-outs are drawn from.  The new one has the
    actions' frequencies in them, a roll-out of cost S counting exp(-S / lambda).  The
    action most frequent at the first step is executed.
    """

    def _plans_to_try(self, plan: np.ndarray) -> np.ndarray:
        plans = np.repeat(plan[None], self.num_roll_outs, axis=0)
        # One without noise, as is usual: the likeliest action at each step.
        plans[0] = plan == plan.max(axis=1, keepdims=True)
        return plans

    def _choose(self, roll_outs: _RollOuts) -> Decision:
        returns = roll_outs.returns
        weights = np.exp((returns - returns.max()) / _TEMPERATURE)
        weights /= weights.sum()
        taken = np.eye(NUM_ACTIONS)[roll_outs.actions]
        frequencies = np.tensordot(weights, taken, axes=1)
        action = int(frequencies[0].argmax())
        first = roll_outs.actions[:, 0] == action
        return Decision(
            action,
            float(np.average(returns[first], weights=weights[first])),
            roll_outs.states,
            returns,
            (1 - _SMOOTHING) * frequencies[1:] + _SMOOTHING / NUM_ACTIONS,
        )
