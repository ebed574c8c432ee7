"""Imitation: the Q-network learns from plans (section IV-B of the paper)."""

from dataclasses import dataclass

import numpy as np
import torch

from rhp_drake.learning.augmentation import Symmetry
from rhp_drake.learning.dataset import Dataset
from rhp_drake.learning.learner import Learner
from rhp_drake.task import REWARD
from rhp_drake.value.q_network import QNetwork


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """How to imitate.

    Attributes:
        margin: k of Eq. 3, actions.
        discount: gamma.
        l2: See `LearnerConfig`, as the rest.
    """

    margin: int = 4
    discount: float = 1.0
    l2: float = 1e-5
    learning_rate: float = 1e-3
    batch_size: int = 512
    num_steps: int = 40_000


def return_of(actions_left: torch.Tensor, discount: float) -> torch.Tensor:
    """Eq. 2: the return of reaching the goal in so many actions, at -1 each."""
    if discount == 1.0:
        return REWARD * actions_left
    return REWARD * (1 - discount**actions_left) / (1 - discount)


def imitation_targets(
    q: torch.Tensor,
    actions: torch.Tensor,
    actions_left: torch.Tensor,
    margin: int,
    discount: float,
) -> torch.Tensor:
    """Targets of Eq. 2 for the chosen actions and of Eq. 3 for the others.

    Args:
        q: The network's values, shape (N, 6), without gradient.
        actions: The plan's actions, shape (N,).
        actions_left: L - l, shape (N,).
        margin: k.
        discount: gamma.

    Returns:
        Shape (N, 6); equal to `q` where Eq. 3 leaves an action as it is.
    """
    chosen = return_of(actions_left, discount)[:, None]
    grounded = return_of(actions_left + margin, discount)[:, None]
    targets = torch.where(q >= chosen, grounded, q)
    return targets.scatter(1, actions[:, None], chosen)


class Plans:
    """State-action pairs on plans, of which batches are drawn.

    Args:
        demonstrations: With at least one plan.
        margin: k.
        discount: gamma.
        device: Of the network.
    """

    def __init__(
        self,
        demonstrations: Dataset,
        margin: int,
        discount: float,
        device: torch.device,
    ) -> None:
        d = demonstrations
        self._states = torch.from_numpy(d.plan_states).float().to(device)
        self._goals = torch.from_numpy(d.goals[d.plan_tasks]).float().to(device)
        self._actions = torch.from_numpy(d.plan_actions).long().to(device)
        self._actions_left = torch.from_numpy(d.plan_actions_left).float().to(device)
        self._margin = margin
        self._discount = discount

    def loss(
        self, network: QNetwork, batch_size: int, generator: np.random.Generator
    ) -> torch.Tensor:
        """The loss of Eq. 2 and 3 on a batch, seen through random symmetries."""
        rows = generator.integers(len(self._states), size=batch_size)
        batch = torch.from_numpy(rows).to(network.device)
        symmetry = Symmetry(batch_size, network.num_objects, generator, network.device)
        q = network(
            symmetry.states(self._states[batch]), symmetry.goals(self._goals[batch])
        )
        targets = imitation_targets(
            q.detach(),
            symmetry.actions(self._actions[batch]),
            self._actions_left[batch],
            self._margin,
            self._discount,
        )
        # Summed over the actions, so that the chosen one weighs as in Eq. 2.
        return (targets - q).square().sum(dim=1).mean()


class Imitation(Learner):
    """Trains a Q-network by Eq. 2 and 3.

    Args:
        network: Its weights are the start.
        demonstrations: With at least one plan.
        config: How.
        generator: Draws the batches and their symmetries.
    """

    def __init__(
        self,
        network: QNetwork,
        demonstrations: Dataset,
        config: ImitationConfig,
        generator: np.random.Generator,
    ) -> None:
        super().__init__(network, config, generator)
        self._plans = Plans(
            demonstrations, config.margin, config.discount, network.device
        )

    def _loss(self) -> torch.Tensor:
        size = self.config.batch_size
        return self._plans.loss(self.network, size, self._generator)
