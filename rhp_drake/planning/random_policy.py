"""The policy that knows nothing: what any other has to beat."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rhp_drake.planning.policy import Decision, check_decidable
from rhp_drake.task import HAND_ACTIONS


@dataclass(frozen=True)
class Random:
    """Executes any of the allowed actions, all equally likely."""

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        """A random action; see `policy.Policy`."""
        allowed = HAND_ACTIONS[check_decidable(state)]
        return Decision(int(generator.choice(allowed)), np.nan)
