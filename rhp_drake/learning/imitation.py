"""Imitation: the Q-network learns from plans (section IV-B of the paper)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from rhp_drake.learning.augmentation import Symmetry
from rhp_drake.learning.demonstrations import Demonstrations
from rhp_drake.task import REWARD
from rhp_drake.value.q_network import QNetwork


@dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """How to imitate.

    Attributes:
        margin: k of Eq. 3, actions.
        discount: gamma.
        l2: Weight of the L2 regularisation.
        learning_rate: Of Adam at the start; it falls to 0 as a cosine.
        batch_size: State-action pairs a step.
        num_epochs: Passes over the pairs.
    """

    margin: int = 4
    discount: float = 1.0
    l2: float = 1e-5
    learning_rate: float = 1e-3
    batch_size: int = 512
    num_epochs: int = 150


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


def imitate(
    network: QNetwork,
    demonstrations: Demonstrations,
    config: ImitationConfig,
    generator: np.random.Generator,
) -> Iterator[float]:
    """Trains the network in place.

    Yields:
        The mean loss of each epoch.
    """
    states = torch.from_numpy(demonstrations.plan_states).float()
    goals = torch.from_numpy(demonstrations.goals[demonstrations.plan_tasks]).float()
    actions = torch.from_numpy(demonstrations.plan_actions).long()
    actions_left = torch.from_numpy(demonstrations.plan_actions_left).float()
    optimizer = torch.optim.Adam(
        network.parameters(), config.learning_rate, weight_decay=config.l2
    )
    batches = -(-len(states) // config.batch_size)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, config.num_epochs * batches
    )
    network.train()
    for _ in range(config.num_epochs):
        order = torch.from_numpy(generator.permutation(len(states)))
        total = 0.0
        for batch in order.split(config.batch_size):
            symmetry = Symmetry(len(batch), network.num_objects, generator)
            q = network(symmetry.states(states[batch]), symmetry.goals(goals[batch]))
            targets = imitation_targets(
                q.detach(),
                symmetry.actions(actions[batch]),
                actions_left[batch],
                config.margin,
                config.discount,
            )
            # Summed over the actions, so that the chosen one weighs as in Eq. 2.
            loss = (targets - q).square().sum(dim=1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.item()
        yield total / batches
    network.eval()
