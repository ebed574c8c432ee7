"""A policy that is got out of loops: where it has been before, a plan takes over.

GP, and RHP at times, go round in circles: the values of some states are so wrong that
they lead back to where it was.  A search over a hundred pushes, best first, sees
farther than six roll-outs do, and knows which states it has seen.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from rhp_drake.planning.best_first import plan_best_first
from rhp_drake.planning.plan_rest import PlanRest
from rhp_drake.planning.policy import Decision, Policy
from rhp_drake.planning.receding_horizon import TransitionFunction, ValueFunction
from rhp_drake.planning.search import near_any
from rhp_drake.push_model.transition import PushModelError

# m: how far a body may be from where the rescue expects it, as for `CheckedPlan`.
_TOLERANCE: Final = 0.01
# Limit of simulated actions: ten times what most plans take.
_MAX_TRANSITIONS: Final = 1000


@dataclass(frozen=True)
class _Memory:
    """What a `Rescued` policy remembers.

    Attributes:
        visited: States in which the policy itself decided, shape (K, 3 + 3 m).
        rest: Of the plan that has taken over, if one has.
        of_policy: The policy's own memory.
    """

    visited: np.ndarray
    rest: PlanRest | None
    of_policy: Any


class Rescued:
    """Follows a policy, and a plan from a state in which the policy has been before.

    The plan is executed while the scene is as it expects.  Then the policy begins anew,
    without what it remembered before.

    Args:
        policy: Decides in states that are new.
        push_model: What the plan is searched in.
        value_function: Guides the search.
    """

    def __init__(
        self,
        policy: Policy,
        push_model: TransitionFunction,
        value_function: ValueFunction,
    ) -> None:
        self._policy = policy
        self._push_model = push_model
        self._value_function = value_function

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The policy's action, or the plan's; see `policy.Policy`."""
        if memory is None:
            memory = _Memory(state[None][:0], None, None)
        rest = memory.rest
        if rest is not None and rest.holds(state, _TOLERANCE):
            decision = rest.decision()
            return _remember(decision, memory.visited, decision.memory, None)
        if near_any(state, memory.visited):
            rest = self._plan(state, goals)
            if rest is not None:
                decision = rest.decision()
                return _remember(decision, memory.visited, decision.memory, None)
        decision = self._policy.decide(state, goals, generator, memory.of_policy)
        visited = np.concatenate([memory.visited, state[None]])
        return _remember(decision, visited, None, decision.memory)

    def _plan(self, state: np.ndarray, goals: np.ndarray) -> PlanRest | None:
        """A plan from the state, if one is found."""
        try:
            found = plan_best_first(
                self._push_model,
                self._value_function,
                state,
                goals,
                max_transitions=_MAX_TRANSITIONS,
            )
        except PushModelError:
            return None
        if found.actions is None or not len(found.actions):
            return None
        return PlanRest(found.actions, found.states)


def _remember(
    decision: Decision, visited: np.ndarray, rest: PlanRest | None, of_policy: Any
) -> Decision:
    return replace(decision, memory=_Memory(visited, rest, of_policy))
