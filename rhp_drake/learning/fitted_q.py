"""Fitted Q: double Q-learning on simulated transitions, with goals in hindsight.

A transition of the push model is true whatever the goals are.  So every action that a
search ever simulated teaches the value of any task in which its state may occur.  The
goals of a sample are those of its task, or, in hindsight (Andrychowicz et al. 2017),
places where things went some actions later in the same search; the search then shows
that the goal can be reached in so many actions, a lower bound of the value (He et al.
2017).  Else the update is Eq. 4 of the paper, with a target network and double
Q-learning (van Hasselt et al. 2016).
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import torch
from torch import nn
from torch.nn.functional import mse_loss, smooth_l1_loss

from rhp_drake.learning.augmentation import NoSymmetry, Symmetry
from rhp_drake.learning.dataset import Dataset
from rhp_drake.learning.imitation import ImitationConfig, Plans
from rhp_drake.learning.learner import Learner
from rhp_drake.task import (
    GOAL_RADIUS,
    MAX_ACTIONS,
    REWARD,
    allowed_actions,
    goals_reached,
    object_positions,
    objects_fallen,
)
from rhp_drake.value.q_network import QNetwork

# Hindsight looks at most this many actions ahead.
_FORESIGHT: Final = 20
# m: a target that moved less teaches nothing about pushing it.
_LEAST_MOTION: Final = 0.01


@dataclass(frozen=True, kw_only=True)
class FittedQConfig:
    """How to fit.

    Attributes:
        discount: gamma.
        l2: See `LearnerConfig`, as the next three.
        target_rate: How far the target network follows at each step.
        hindsight: How many of a batch's samples get goals in hindsight.
        search_returns: Whether a way to the goal that was simulated bounds the value.
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
    search_returns: bool = False
    double_q: bool = True
    symmetry: bool = True
    squared_errors: bool = False
    imitation_weight: float = 0.0


@dataclass(frozen=True)
class Samples:
    """N transitions with the goals they are looked at for.

    Attributes:
        states: Shape (N, 3 + 3 m).
        actions: Shape (N,).
        next_states: Shape (N, 3 + 3 m).
        goals: Shape (N, m, 2).
        least_returns: What the return is known to reach at least, shape (N,).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    goals: np.ndarray
    least_returns: np.ndarray


def _in_disc(centres: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Points uniform in the discs of radius `GOAL_RADIUS` around (..., 2) centres."""
    shape = centres.shape[:-1]
    radius = GOAL_RADIUS * np.sqrt(generator.random(shape))
    angle = 2 * np.pi * generator.random(shape)
    return centres + np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def sample(
    sources: Sequence[Dataset], config: FittedQConfig, generator: np.random.Generator
) -> Samples:
    """Draws a batch of transitions and their goals, as many from each source."""
    num_samples = config.batch_size
    shares = np.diff(np.arange(len(sources) + 1) * num_samples // len(sources))
    parts = [
        _sample(source, int(share), config, generator)
        for source, share in zip(sources, shares, strict=True)
    ]
    return Samples(
        **{
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in fields(Samples)
        }
    )


def _sample(
    data: Dataset,
    num_samples: int,
    config: FittedQConfig,
    generator: np.random.Generator,
) -> Samples:
    num_hindsight = int(config.hindsight * num_samples)
    rows = generator.integers(len(data.search_actions), size=num_samples)
    goals = data.goals[data.search_tasks[rows]]

    # The first of them in hindsight: `ends` is where the goals come from, `rows` a
    # transition on the way there, `num_actions` of them before the end.
    ends = rows[:num_hindsight].copy()
    num_actions = np.ones(num_hindsight, dtype=int)
    wanted = generator.integers(1, _FORESIGHT + 1, size=num_hindsight)
    for _ in range(_FORESIGHT - 1):
        origins = data.search_origins[rows[:num_hindsight]]
        back = (num_actions < wanted) & (origins >= 0)
        rows[:num_hindsight][back] = origins[back]
        num_actions[back] += 1
    least = np.full(num_samples, -np.inf)
    if config.search_returns:
        left = data.search_actions_left[rows]
        least[left > 0] = REWARD * left[left > 0]
    start = object_positions(data.search_states[rows[:num_hindsight]])
    end = object_positions(data.search_next_states[ends])
    moved = np.linalg.norm(end[:, 0] - start[:, 0], axis=1) > _LEAST_MOTION
    found = _in_disc(end, generator)
    # An obstacle still in its task's region needs no other one.
    of_task = goals[:num_hindsight]
    kept = np.linalg.norm(end - of_task, axis=-1) <= GOAL_RADIUS
    kept[:, 0] = False
    found = np.where(kept[..., None], of_task, found)
    moved &= ~objects_fallen(data.search_next_states[ends])
    goals[:num_hindsight][moved] = found[moved]
    least[:num_hindsight][moved] = REWARD * num_actions[moved]
    return Samples(
        data.search_states[rows],
        data.search_actions[rows],
        data.search_next_states[rows],
        goals,
        least,
    )


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
                self.sources[0], ImitationConfig.margin, config.discount
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
        config, network = self._config, self.network
        batch = sample(self.sources, config, self._generator)
        reached = torch.from_numpy(goals_reached(batch.next_states, batch.goals))
        fallen = torch.from_numpy(objects_fallen(batch.next_states))
        allowed = torch.from_numpy(allowed_actions(batch.next_states))
        # An episode ends at the goal: nobody asks for values there.
        asked = torch.from_numpy(~goals_reached(batch.states, batch.goals))

        symmetry = (
            Symmetry(len(asked), network.num_objects, self._generator)
            if config.symmetry
            else NoSymmetry()
        )
        goals = symmetry.goals(torch.from_numpy(batch.goals).float())
        states = symmetry.states(torch.from_numpy(batch.states))
        next_states = symmetry.states(torch.from_numpy(batch.next_states))
        actions = symmetry.actions(torch.from_numpy(batch.actions).long())
        with torch.no_grad():
            target_q_next = self._target(next_states, goals)
            targets = double_q_targets(
                network(next_states, goals) if config.double_q else target_q_next,
                target_q_next,
                symmetry.action_masks(allowed),
                reached,
                fallen,
                config.discount,
            )
            least = torch.from_numpy(batch.least_returns).float()
            targets = torch.maximum(targets, least)
        q = network(states, goals).gather(1, actions[:, None])[:, 0]
        loss = mse_loss if config.squared_errors else smooth_l1_loss
        losses = loss(q, targets, reduction="none")
        return (losses * asked).mean() + self._imitation_loss()

    def _imitation_loss(self) -> torch.Tensor | float:
        if self._plans is None:
            return 0.0
        config = self._config
        loss = self._plans.loss(self.network, config.batch_size, self._generator)
        return config.imitation_weight * loss
