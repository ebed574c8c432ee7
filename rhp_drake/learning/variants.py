"""How reinforcement learning is done: ours, the paper's, and ours but for one thing."""

from dataclasses import dataclass, field, replace
from typing import Final

from rhp_drake.learning.fitted_q import FittedQConfig
from rhp_drake.learning.reinforcement import Rounds


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way of RHP-guided reinforcement learning.

    Attributes:
        learning: How the network learns.
        rounds: How RHP acts.
        from_scratch: Whether it begins with a random network and no demonstrations.
    """

    learning: FittedQConfig = field(default_factory=FittedQConfig)
    rounds: Rounds = field(default_factory=Rounds)
    from_scratch: bool = False


BEST: Final = Variant()
# Section V: Q-learning on plans and on what was executed, squared errors, a gradient
# step for each action (an episode has some 16).  The paper names neither learning rate
# nor target network, and not what keeps the values of actions that were never tried
# from rising.  At `BEST`'s rate and without a target network greedy success fell from
# 70 to 35 % of 200 validation tasks in 4000 steps; at a fifth and with one, to 40.
# So the loss of imitation stays.
PAPER: Final = Variant(
    learning=FittedQConfig(
        learning_rate=1e-4,
        hindsight=0.0,
        search_returns=False,
        double_q=False,
        squared_errors=True,
        imitation_weight=0.1,
        batch_size=512,
    ),
    rounds=Rounds(num_searches=0, executed_only=True),
)
_LEARNING: Final = BEST.learning
_ROUNDS: Final = BEST.rounds
VARIANTS: Final = {
    "best": BEST,
    "paper": PAPER,
    "no_hindsight": replace(BEST, learning=replace(_LEARNING, hindsight=0.0)),
    "no_search_returns": replace(
        BEST, learning=replace(_LEARNING, search_returns=False)
    ),
    "no_double_q": replace(BEST, learning=replace(_LEARNING, double_q=False)),
    "no_symmetry": replace(BEST, learning=replace(_LEARNING, symmetry=False)),
    "uncertain_physics": replace(BEST, rounds=replace(_ROUNDS, uncertainty="high")),
    "no_searches": replace(BEST, rounds=replace(_ROUNDS, num_searches=0)),
    "epsilon_greedy": replace(BEST, rounds=replace(_ROUNDS, horizon=0)),
    "executed_only": replace(
        BEST, rounds=replace(_ROUNDS, num_searches=0, executed_only=True)
    ),
    "from_scratch": replace(BEST, from_scratch=True),
}
