"""KDP as a policy: the kinodynamic RRT's plan, executed open loop."""

from typing import Any

import numpy as np

from rhp_drake.planning.kinodynamic_rrt import IMPROVEMENT, plan
from rhp_drake.planning.policy import Decision, PolicyError
from rhp_drake.push_model.transition import PushModel


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
                self._push_model,
                state,
                goals,
                generator,
                improvement=IMPROVEMENT,
                time_limit=self._time_limit,
            )
            if found.actions is None:
                raise PolicyError(
                    f"the planner found no plan in {found.seconds:.0f} s."
                )
            memory = tuple(found.actions)
        if not memory:
            raise PolicyError("the plan has ended and the goal is not reached.")
        return Decision(int(memory[0]), -float(len(memory)), memory=memory[1:])
