"""How reinforcement learning is done: ours, the paper's, and ours but for one thing."""

from dataclasses import dataclass, field, replace
from typing import Any, Final

from rhp_drake.learning.demonstrators import Acting
from rhp_drake.learning.fitted_q import FittedQConfig
from rhp_drake.learning.reinforcement import Rounds


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way of RHP-guided reinforcement learning.

    Attributes:
        learning: How the network learns.
        rounds: How RHP acts.
        from_scratch: Whether it begins with a random network and no demonstrations.
        plans_only: Whether demonstrations are plans, without what else was simulated.
        network: Its architecture, see `value.q_network`.
    """

    learning: FittedQConfig = field(default_factory=FittedQConfig)
    rounds: Rounds = field(default_factory=Rounds)
    from_scratch: bool = False
    plans_only: bool = False
    network: str = "set"


def _acting(**changes: Any) -> Rounds:
    """The default rounds, but for how RHP acts."""
    return Rounds(acting=Acting(**changes))


BEST: Final = Variant()
# Section V: Q-learning on plans and on what was executed, squared errors, a gradient
# step for each action (an episode has some 16).  The loss of imitation stays, which the
# paper does not say: it is to hold down the values of actions that were never tried.
PAPER: Final = Variant(
    learning=FittedQConfig(
        learning_rate=1e-4,
        hindsight=0.0,
        double_q=False,
        squared_errors=True,
        imitation_weight=0.1,
        batch_size=128,
    ),
    rounds=Rounds(num_tasks=60, acting=Acting(executed_only=True)),
    plans_only=True,
    network="paper",
)
_LEARNING: Final = BEST.learning
VARIANTS: Final = {
    "best": BEST,
    "from_scratch": replace(BEST, from_scratch=True),
    "executed_only": replace(BEST, rounds=_acting(executed_only=True)),
    "no_hindsight": replace(BEST, learning=replace(_LEARNING, hindsight=0.0)),
    "paper_network": replace(BEST, network="paper"),
    "no_symmetry": replace(BEST, learning=replace(_LEARNING, symmetry=False)),
    "plans_only": replace(BEST, plans_only=True),
    "no_double_q": replace(BEST, learning=replace(_LEARNING, double_q=False)),
    "epsilon_greedy": replace(BEST, rounds=_acting(horizon=0)),
    "uncertain_physics": replace(BEST, rounds=_acting(uncertainty="high")),
    "paper": PAPER,
    "n_step": replace(BEST, learning=replace(_LEARNING, bootstrap_steps=3)),
    "pair": replace(BEST, network="pair"),
    "resets": replace(BEST, rounds=_acting(resets=0.5)),
}
