"""KDP with open eyes: a plan is executed while the scene is as the plan expects."""

from typing import Any

import numpy as np

from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.planning.open_loop import Planner
from rhp_drake.planning.plan_rest import PlanRest
from rhp_drake.planning.policy import Decision, PolicyError
from rhp_drake.push_model.transition import PushModel


class CheckedPlan:
    """The policy that plans, and plans anew when the scene is not as expected.

    Before each action it compares the state with the one that the plan expects there.
    It plans anew, from the state as it is, if they deviate, if the next action is not
    allowed, or if the plan has ended short of the goal.

    Args:
        push_model: What it plans in.
        time_limit: Limit of each planning's computation, s.
        tolerance: The `deviation` up to which a plan is kept, m.
        planner: Makes the plans.
    """

    def __init__(
        self,
        push_model: PushModel,
        time_limit: float = 120.0,
        tolerance: float = 0.01,
        planner: Planner = plan,
    ) -> None:
        self._push_model = push_model
        self._time_limit = time_limit
        self._tolerance = tolerance
        self._planner = planner

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """The next action of the plan, old or new; see `policy.Policy`."""
        if memory is not None and memory.holds(state, self._tolerance):
            return memory.decision()
        found = self._planner(
            self._push_model, state, goals, generator, time_limit=self._time_limit
        )
        if found.actions is None:
            problem = f"the planner found no plan in {found.seconds:.0f} s."
            if memory is not None:
                problem = f"the scene is not as the plan expects it, and {problem}"
            raise PolicyError(problem)
        if not len(found.actions):
            raise PolicyError("all objects are at their goals already.")
        return PlanRest(found.actions, found.states).decision()
