"""How reinforcement learning is done: ours, the paper's, and what lies between."""

from dataclasses import dataclass, field
from typing import Final

from rhp_drake.learning.fitted_q import FittedQConfig
from rhp_drake.learning.reinforcement import Rounds


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way of RHP-guided reinforcement learning.

    Attributes:
        learning: How the network learns.
        rounds: How RHP acts.
    """

    learning: FittedQConfig = field(default_factory=FittedQConfig)
    rounds: Rounds = field(default_factory=Rounds)


BEST: Final = Variant()
# Section V: Q-learning without a target network, on executed transitions and plans,
# squared errors, a gradient step for each action (an episode has some 16).
PAPER: Final = Variant(
    learning=FittedQConfig(
        target_rate=1.0,
        hindsight=0.0,
        search_returns=False,
        double_q=False,
        squared_errors=True,
    ),
    rounds=Rounds(
        num_tasks=60,
        num_steps=1000,
        uncertainty="none",
        num_searches=0,
        executed_only=True,
    ),
)

VARIANTS: Final = {"best": BEST, "paper": PAPER}
