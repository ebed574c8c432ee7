"""Fitted Q: double Q-learning on simulated transitions.

The update is Eq. 4 of the paper, with a target network and double Q-learning (van
Hasselt et al. 2016), bounded from below by returns that a search is known to reach.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn.functional import mse_loss, smooth_l1_loss

from rhp_drake.learning.augmentation import NoSymmetry, Symmetry
from rhp_drake.learning.dataset import Dataset
from rhp_drake.learning.imitation import ImitationConfig, Plans
from rhp_drake.learning.learner import Learner
from rhp_drake.learning.sampling import Samples, sample
from rhp_drake.task import (
    MAX_ACTIONS,
    REWARD,
    allowed_actions,
    goals_reached,
    objects_fallen,
)
from rhp_drake.value.q_network import QNetwork


@dataclass(frozen=True, kw_only=True)
class FittedQConfig:
    """How to fit.

    Attributes:
        discount: gamma.
        l2: See `LearnerConfig`, as the next three.
        target_rate: How far the target network follows at each step.
        hindsight: How many of a batch's samples get goals in hindsight.
        double_q: Whether the target's action is the network's choice, not the target
            network's own.
        symmetry: Whether samples are seen through random symmetries.
        squared_errors: Whether errors above 1 count squared, or by their size.
        imitation_weight: Of the loss of imitation (Eq. 2 and 3) beside that of Eq. 4,
            on the plans of the first source; as Hester et al. (2018) do, it holds down
            the values of actions that were never tried.
    """

    discount: float = 1.0
    l2: float = 1e-6
    learning_rate: float = 1e-3
    batch_size: int = 1024
    num_steps: int = 40_000
    target_rate: float = 0.005
    hindsight: float = 0.5
    double_q: bool = True
    symmetry: bool = True
    squared_errors: bool = False
    imitation_weight: float = 0.0
    bootstrap_steps: int = 1


def double_q_targets(
    q_next: torch.Tensor,
    target_q_next: torch.Tensor,
    allowed_next: torch.Tensor,
    reached: torch.Tensor,
    fallen: torch.Tensor,
    discount: float,
) -> torch.Tensor:
    """Targets of Eq. 4, by double Q-learning.

    Args:
        q_next: The network's values of the next states, shape (N, 6).
        target_q_next: The target network's, shape (N, 6).
        allowed_next: Which actions are allowed there, shape (N, 6).
        reached: Whether the next state is a goal state, shape (N,).
        fallen: Whether an object fell there, shape (N,).
        discount: gamma.

    Returns:
        Shape (N,).
    """
    chosen = q_next.masked_fill(~allowed_next, -torch.inf).argmax(dim=1, keepdim=True)
    # No return is worse than that of using up all actions: this bounds the values.
    future = target_q_next.gather(1, chosen)[:, 0].clamp(REWARD * MAX_ACTIONS, 0)
    future = torch.where(reached, 0.0, future)
    future = torch.where(fallen, REWARD * MAX_ACTIONS, future)
    return REWARD + discount * future


class FittedQ(Learner):
    """Trains a Q-network by double Q-learning.

    Args:
        network: Its weights are the start.
        sources: What was simulated; each has the same share of a batch, so that a few
            roll-outs count beside many searches.
        config: How.
        generator: Draws the batches, their goals and symmetries.

    Attributes:
        sources: The same; more may be added.
    """

    def __init__(
        self,
        network: QNetwork,
        sources: Sequence[Dataset],
        config: FittedQConfig,
        generator: np.random.Generator,
    ) -> None:
        super().__init__(network, config, generator)
        self._config = config
        self.sources = list(sources)
        self._plans = None
        if config.imitation_weight:
            self._plans = Plans(
                self.sources[0],
                ImitationConfig.margin,
                config.discount,
                network.device,
            )
        self._target = deepcopy(network)

    def _modules(self) -> dict[str, nn.Module]:
        return super()._modules() | {"target": self._target}

    def step(self) -> None:
        """One gradient step, which the target network follows; see `Learner`."""
        super().step()
        with torch.no_grad():
            for ours, theirs in zip(
                self._target.parameters(), self.network.parameters(), strict=True
            ):
                ours.lerp_(theirs, self._config.target_rate)

    def _loss(self) -> torch.Tensor:
        members = getattr(self.network, "members", [self.network])
        return sum(self._member_loss(member) for member in members)

    def _member_loss(self, member) -> torch.Tensor:
        config = self._config
        batch = sample(
            self.sources,
            config.batch_size,
            self._generator,
            hindsight=config.hindsight,
            foresight=config.bootstrap_steps,
        )
        network = self.network
        symmetry = (
            Symmetry(
                config.batch_size, network.num_objects, self._generator, network.device
            )
            if config.symmetry
            else NoSymmetry()
        )
        goals = symmetry.goals(self._tensor(batch.goals).float())
        states = symmetry.states(self._tensor(batch.states))
        actions = symmetry.actions(self._tensor(batch.actions).long())
        targets = self._targets(batch, symmetry, goals)
        q = member(states, goals).gather(1, actions[:, None])[:, 0]
        loss = mse_loss if config.squared_errors else smooth_l1_loss
        losses = loss(q, targets, reduction="none")
        # An episode ends at the goal: nobody asks for values there.
        asked = self._tensor(~goals_reached(batch.states, batch.goals))
        return (losses * asked).mean() + self._imitation_loss()

    @torch.no_grad()
    def _targets(
        self, batch: Samples, symmetry: Symmetry | NoSymmetry, goals: torch.Tensor
    ) -> torch.Tensor:
        """What the values (N,) of a batch should be, seen through the symmetries."""
        config = self._config
        targets = self._one_step(batch.next_states, batch, symmetry, goals)
        if config.bootstrap_steps > 1:
            later = self._one_step(batch.later_states, batch, symmetry, goals)
            before = self._tensor(batch.later_steps).float() - 1
            targets = torch.maximum(targets, REWARD * before + later)
        least = self._tensor(batch.least_returns).float()
        return torch.maximum(targets, least)

    def _one_step(self, arrays, batch, symmetry, goals):
        config = self._config
        next_states = symmetry.states(self._tensor(arrays))
        allowed = self._tensor(allowed_actions(arrays))
        least = getattr(self._target, "least", self._target)
        target_q_next = least(next_states, goals)
        return double_q_targets(
            self.network(next_states, goals) if config.double_q else target_q_next,
            target_q_next,
            symmetry.action_masks(allowed),
            self._tensor(goals_reached(arrays, batch.goals)),
            self._tensor(objects_fallen(arrays)),
            config.discount,
        )

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        """The array where the network is."""
        return torch.from_numpy(array).to(self.network.device)

    def _imitation_loss(self) -> torch.Tensor | float:
        if self._plans is None:
            return 0.0
        config = self._config
        loss = self._plans.loss(self.network, config.batch_size, self._generator)
        return config.imitation_weight * loss
