"""RHP: the receding-horizon planner of section VI of the paper, and greedy GP."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from rhp_drake.planning.policy import Decision, check_decidable
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.task import (
    FAILURE_VALUE,
    HAND_ACTIONS,
    REWARD,
    allowed_actions,
    goals_reached,
    objects_fallen,
)


class TransitionFunction(Protocol):
    """Whatever predicts T(s, a), e.g. a `PushModel`."""

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Next states (N, 3 + 3 m) of states (N, 3 + 3 m) and actions (N,)."""
        ...


class ValueFunction(Protocol):
    """Whatever estimates q(s, a), e.g. a `QNetwork`."""

    def values(self, states: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Values (N, 6) of states (N, 3 + 3 m) for goals (m, 2)."""
        ...


def masked_values(
    value_function: ValueFunction,
    states: np.ndarray,
    goals: np.ndarray,
    action_set: np.ndarray = HAND_ACTIONS,
) -> np.ndarray:
    """q(s, a), -inf where the action is not allowed; shape (N, 6)."""
    q = value_function.values(states, goals)
    return np.where(allowed_actions(states, action_set), q, -np.inf)


def sample_softmax(
    q: np.ndarray, temperature: float, generator: np.random.Generator
) -> np.ndarray:
    """Draws an action for each row of q by Eq. 5, the soft-max of q / tau.

    Args:
        q: Shape (N, 6); -inf has no chance.
        temperature: tau > 0, in units of return.
        generator: Draws one number a row.
    """
    weights = np.exp((q - q.max(axis=1, keepdims=True)) / temperature)
    return sample_weighted(weights, generator)


def sample_weighted(weights: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draws a column for each row, as likely as its weight.

    Args:
        weights: At least 0 and not all 0 in a row, shape (N, A).
        generator: Draws one number a row.
    """
    cumulative = weights.cumsum(axis=1)
    draws = generator.random(len(weights)) * cumulative[:, -1]
    return (cumulative <= draws[:, None]).sum(axis=1)


def step_distinct(
    push_model: TransitionFunction, states: np.ndarray, actions: np.ndarray
) -> np.ndarray:
    """The push model's step, in which equal (state, action) pairs are simulated once.

    Args:
        push_model: T.
        states: Shape (N, 3 + 3 m).
        actions: Shape (N,).
    """
    pairs = np.column_stack([states, actions])
    distinct, inverse = np.unique(pairs, axis=0, return_inverse=True)
    stepped = push_model.step(
        np.ascontiguousarray(distinct[:, :-1]), distinct[:, -1].astype(int)
    )
    return stepped[inverse.reshape(-1)]


@dataclass(frozen=True)
class RecedingHorizon:
    """Simulates n roll-outs of h actions, executes the best one's first action.

    At every step of a roll-out an action is drawn from the soft-max of the values
    (Eq. 5).  The return of a roll-out is its rewards up to the horizon, plus the
    largest value there (Eq. 1); a roll-out that reaches the goal ends there.  One that
    pushes an object off the table is chosen only if all do.  All roll-outs go forward
    together: one query of the value function and one batch of the push model a depth,
    in which equal (state, action) pairs are simulated once.

    With h = 0 this is the greedy policy, GP.  It also decides where the push model
    refuses the state.

    Attributes:
        push_model: T, what the roll-outs are simulated in.
        value_function: q.
        num_roll_outs: n.
        horizon: h.
        temperature: tau, in units of return (one action costs one).
        discount: gamma.
        action_set: The actions whose values the value function gives, in its order.
    """

    push_model: TransitionFunction
    value_function: ValueFunction
    num_roll_outs: int
    horizon: int
    temperature: float
    discount: float = 1.0
    action_set: np.ndarray = field(default_factory=lambda: HAND_ACTIONS)

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The first action of the best roll-out; see `policy.Policy`."""
        check_decidable(state, self.action_set)
        q = self._masked_values(state[None], goals)
        best = int(q[0].argmax())
        greedy = Decision(int(self.action_set[best]), float(q[0, best]))
        if self.horizon == 0:
            return greedy
        try:
            return self._look_ahead(state, goals, q, generator)
        except PushModelError:
            # Where objects are smaller than the model believes, they come so close that
            # it sees them overlap.  To wait would not part them.
            return greedy

    def _look_ahead(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        q: np.ndarray,
        generator: np.random.Generator,
    ) -> Decision:
        """The first action of the best roll-out; `q` are the state's values (1, 6)."""
        n = self.num_roll_outs
        states = np.repeat(state[None], n, axis=0)
        path = [states]
        returns = np.zeros(n)
        q = np.repeat(q, n, axis=0)
        alive = np.ones(n, dtype=bool)
        fallen = np.zeros(n, dtype=bool)
        first_actions = np.zeros(n, dtype=int)
        for depth in range(self.horizon):
            choices = sample_softmax(q, self.temperature, generator)
            actions = self.action_set[choices]
            if depth == 0:
                first_actions = actions
            states = states.copy()
            states[alive] = step_distinct(
                self.push_model, states[alive], actions[alive]
            )
            path.append(states)
            returns[alive] += self.discount**depth * REWARD
            fallen |= objects_fallen(states)
            alive &= ~fallen & ~goals_reached(states, goals)
            if not alive.any():
                break
            q = self._masked_values(states, goals)
        if alive.any():
            returns[alive] += self.discount**self.horizon * q[alive].max(axis=1)
        # Whatever the values say: worse than any roll-out that keeps all objects.
        returns[fallen] = returns[~fallen].min(initial=FAILURE_VALUE) + REWARD
        best = int(returns.argmax())
        return Decision(
            int(first_actions[best]),
            float(returns[best]),
            np.stack(path, axis=1),
            returns,
        )

    def _masked_values(self, states: np.ndarray, goals: np.ndarray) -> np.ndarray:
        return masked_values(self.value_function, states, goals, self.action_set)
