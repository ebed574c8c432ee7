"""What a policy is: the small protocol that RHP, greedy and open loop share."""

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from rhp_drake.task import HAND_ACTIONS, allowed_actions


class PolicyError(Exception):
    """The policy has no action to offer; the message says why."""


class PlanEndedError(PolicyError):
    """The policy's plan was executed to its end, and the goal is not reached."""


@dataclass(frozen=True)
class Decision:
    """What a policy decided in one state, and why.

    Attributes:
        action: The `rhp_drake.task.Action` to execute.
        value: Expected return of that action, as the policy sees it; nan if it has
            no idea.
        roll_outs: The states the policy looked at, shape (n, h + 1, 3 + 3 m), the
            present state first; n = 0 if it did not look ahead.
        returns: The return of each roll-out, shape (n,).
        memory: What the policy wants to be given at its next decision.
    """

    action: int
    value: float
    roll_outs: np.ndarray = field(default_factory=lambda: np.empty((0, 1, 0)))
    returns: np.ndarray = field(default_factory=lambda: np.empty(0))
    memory: Any = None


class Policy(Protocol):
    """Maps states to actions.

    A policy is immutable and may be shared, by threads too: whoever runs an episode
    keeps its memory, as a Drake system keeps its state in a context.
    """

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """Chooses an allowed action.

        Args:
            state: Shape (3 + 3 m,).
            goals: Shape (m, 2).
            generator: Where this decision's random draws come from.
            memory: `Decision.memory` of the episode's decision before this one,
                None at the first.

        Raises:
            PolicyError: If it has no action to offer.
        """
        ...


def check_decidable(
    state: np.ndarray, action_set: np.ndarray = HAND_ACTIONS
) -> np.ndarray:
    """Which actions a policy has to choose from, booleans of shape (A,).

    Args:
        state: Shape (3 + 3 m,).
        action_set: The A actions it knows.

    Raises:
        PolicyError: If the state is not finite, or no action is allowed there.
    """
    if not np.isfinite(state).all():
        raise PolicyError("the state is not finite.")
    allowed = allowed_actions(state, action_set)
    if not allowed.any():
        raise PolicyError("no action keeps the hand in the workspace.")
    return allowed
