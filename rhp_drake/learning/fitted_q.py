"""Fitted Q: double Q-learning on simulated transitions, with goals relabelled.

A transition of the push model is true whatever the goals are.  So every action that a
search or a roll-out ever simulated teaches the value of any task in which its state
may occur: each sample draws new goals, by hindsight near where things went.  The
update is Eq. 4 of the paper with a target network and double Q-learning (van Hasselt
et al. 2016).
"""

from dataclasses import dataclass
import io
import json
from pathlib import Path
import pickle
from typing import Final

import numpy as np
import torch

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.learning.augmentation import Symmetry
from rhp_drake.learning.demonstrations import Demonstrations
from rhp_drake.task import (
    GOAL_RADIUS,
    MAX_ACTIONS,
    REWARD,
    allowed_actions,
    goals_reached,
    objects_fallen,
)
from rhp_drake.value.q_network import QNetwork

# How often a sample's goal for the target is: where the target went, the task's own.
# Else it is a place between the two.
_GOAL_AT_NEXT: Final = 0.2
_GOAL_OF_TASK: Final = 0.6
# How often an obstacle keeps the region of its task, rather than one drawn around
# where it stands.
_OBSTACLE_OF_TASK: Final = 0.6


@dataclass(frozen=True, kw_only=True)
class FittedQConfig:
    """How to fit.

    Attributes:
        discount: gamma.
        l2: Weight of the L2 regularisation.
        learning_rate: Of Adam at the start; it falls to 0 as a cosine.
        batch_size: Transitions a step.
        num_steps: Gradient steps.
        target_rate: How far the target network follows at each step.
    """

    discount: float = 1.0
    l2: float = 1e-6
    learning_rate: float = 5e-4
    batch_size: int = 1024
    num_steps: int = 30_000
    target_rate: float = 0.005


@dataclass(frozen=True)
class Transitions:
    """T transitions, each with the goals of the task it was simulated for.

    Attributes:
        states: Shape (T, 3 + 3 m).
        actions: Shape (T,).
        next_states: Shape (T, 3 + 3 m).
        goals: Shape (T, m, 2).
    """

    states: np.ndarray
    actions: np.ndarray
    next_states: np.ndarray
    goals: np.ndarray

    @classmethod
    def from_demonstrations(cls, demonstrations: Demonstrations) -> "Transitions":
        """All that was simulated for the demonstrations."""
        return cls(
            demonstrations.search_states,
            demonstrations.search_actions,
            demonstrations.search_next_states,
            demonstrations.goals[demonstrations.search_tasks].astype(np.float32),
        )


def _in_disc(centres: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Points uniform in the discs of radius `GOAL_RADIUS` around (..., 2) centres."""
    shape = centres.shape[:-1]
    radius = GOAL_RADIUS * np.sqrt(generator.random(shape))
    angle = 2 * np.pi * generator.random(shape)
    return centres + np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def relabel(batch: Transitions, generator: np.random.Generator) -> np.ndarray:
    """New goals (N, m, 2) for a batch of transitions."""
    goals = batch.goals.copy()
    next_objects = batch.next_states[:, 3:].reshape(len(goals), -1, 3)[..., :2]
    objects = batch.states[:, 3:].reshape(len(goals), -1, 3)[..., :2]
    choice = generator.random(len(goals))
    hindsight = _in_disc(next_objects[:, 0], generator)
    fraction = generator.random((len(goals), 1))
    between = hindsight + fraction * (goals[:, 0] - hindsight)
    goals[:, 0] = np.select(
        [
            (choice < _GOAL_AT_NEXT)[:, None],
            (choice < _GOAL_AT_NEXT + _GOAL_OF_TASK)[:, None],
        ],
        [hindsight, goals[:, 0]],
        between,
    )
    keep = generator.random(goals[:, 1:].shape[:2]) < _OBSTACLE_OF_TASK
    goals[:, 1:] = np.where(
        keep[..., None], goals[:, 1:], _in_disc(objects[:, 1:], generator)
    )
    return goals


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


class FittedQ:
    """Trains a Q-network in place, step by step.

    Args:
        network: Its weights are the start.
        config: How.
        generator: Draws the batches, their goals and symmetries.

    Attributes:
        num_steps: Steps taken so far.
        mean_loss: Running mean of the loss.
    """

    def __init__(
        self, network: QNetwork, config: FittedQConfig, generator: np.random.Generator
    ) -> None:
        self.num_steps = 0
        self.mean_loss = 0.0
        self._network = network
        self._config = config
        self._generator = generator
        self._target = QNetwork(network.num_objects)
        self._target.load_state_dict(network.state_dict())
        self._optimizer = torch.optim.Adam(
            network.parameters(), config.learning_rate, weight_decay=config.l2
        )
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self._optimizer, config.num_steps
        )

    def step(self, transitions: Transitions) -> None:
        """One gradient step on a random batch."""
        config, network = self._config, self._network
        rows = self._generator.integers(len(transitions.actions), size=config.batch_size)
        batch = Transitions(*(array[rows] for array in vars(transitions).values()))
        goals = relabel(batch, self._generator)
        reached = torch.from_numpy(goals_reached(batch.next_states, goals))
        fallen = torch.from_numpy(objects_fallen(batch.next_states))
        allowed = torch.from_numpy(allowed_actions(batch.next_states))

        symmetry = Symmetry(len(rows), network.num_objects, self._generator)
        goals_seen = symmetry.goals(torch.from_numpy(goals).float())
        states = symmetry.states(torch.from_numpy(batch.states))
        next_states = symmetry.states(torch.from_numpy(batch.next_states))
        actions = symmetry.actions(torch.from_numpy(batch.actions).long())
        with torch.no_grad():
            targets = double_q_targets(
                network(next_states, goals_seen),
                self._target(next_states, goals_seen),
                symmetry.action_masks(allowed),
                reached,
                fallen,
                config.discount,
            )
        q = network(states, goals_seen).gather(1, actions[:, None])[:, 0]
        loss = torch.nn.functional.smooth_l1_loss(q, targets)
        self._optimizer.zero_grad()
        loss.backward()
        self._optimizer.step()
        self._schedule.step()
        with torch.no_grad():
            for ours, theirs in zip(
                self._target.parameters(), network.parameters(), strict=True
            ):
                ours.lerp_(theirs, config.target_rate)
        self.num_steps += 1
        weight = max(1 / self.num_steps, 0.001)
        self.mean_loss += weight * (loss.item() - self.mean_loss)

    def save(self, path: Path) -> None:
        """Writes a checkpoint: going on from it is as if never stopped."""
        buffer = io.BytesIO()
        torch.save(
            {
                "network": self._network.state_dict(),
                "target": self._target.state_dict(),
                "optimizer": self._optimizer.state_dict(),
                "schedule": self._schedule.state_dict(),
                "generator": json.dumps(self._generator.bit_generator.state),
                "num_steps": self.num_steps,
                "mean_loss": self.mean_loss,
                "config": vars(self._config),
            },
            buffer,
        )
        write_atomically(path, buffer.getvalue())

    def resume(self, path: Path) -> None:
        """Goes on from a checkpoint of `save`.

        Raises:
            InputError: If it cannot be read, or was made with another configuration.
        """
        try:
            saved = torch.load(path, weights_only=True)
            if saved["config"] != vars(self._config):
                raise InputError(
                    f"{path}: a checkpoint of another configuration; delete it to "
                    "start anew."
                )
            self._network.load_state_dict(saved["network"])
            self._target.load_state_dict(saved["target"])
            self._optimizer.load_state_dict(saved["optimizer"])
            self._schedule.load_state_dict(saved["schedule"])
            self._generator.bit_generator.state = json.loads(saved["generator"])
            self.num_steps, self.mean_loss = saved["num_steps"], saved["mean_loss"]
        except (OSError, RuntimeError, KeyError, pickle.UnpicklingError) as error:
            raise InputError(f"{path}: not a readable checkpoint ({error}).") from error
