"""KDP as a policy: the kinodynamic RRT's plan, executed open loop."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.planning.plan_rest import PlanRest
from rhp_drake.planning.policy import Decision, PlanEndedError, PolicyError
from rhp_drake.planning.search import Plan
from rhp_drake.push_model.transition import PushModel

# Plans with a push model, state, goals, generator and time_limit (by name), as
# `kinodynamic_rrt.plan` does.
Planner: TypeAlias = Callable[..., Plan]


class OpenLoop:
    """The policy that plans once and executes the plan blindly: KDP of Table I.

    Args:
        push_model: What it plans in.
        time_limit: Limit of computation, s.
        planner: Makes the plan.
    """

    def __init__(
        self, push_model: PushModel, time_limit: float = 120.0, planner: Planner = plan
    ) -> None:
        self._push_model = push_model
        self._time_limit = time_limit
        self._planner = planner

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The plan's next action; see `policy.Policy`.  Plans at the first call."""
        if memory is None:
            found = self._planner(
                self._push_model, state, goals, generator, time_limit=self._time_limit
            )
            if found.actions is None:
                raise PolicyError(
                    f"the planner found no plan in {found.seconds:.0f} s."
                )
            memory = PlanRest(found.actions, found.states)
        if not len(memory.actions):
            raise PlanEndedError("the plan has ended and the goal is not reached.")
        return memory.decision()
