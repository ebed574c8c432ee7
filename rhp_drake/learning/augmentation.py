"""Symmetries of the task, as random changes of training samples.

Obstacles are interchangeable, and the mirror image of a push is a push: the
workspace is symmetric about y = 0, and so are the hand and the boxes.
"""

from typing import Final

import numpy as np
import torch

from rhp_drake.task import Action

# What each action becomes in the mirror.
_MIRRORED_ACTIONS: Final = torch.tensor(
    [
        Action.FORWARD,
        Action.BACKWARD,
        Action.RIGHT,
        Action.LEFT,
        Action.CLOCKWISE,
        Action.COUNTERCLOCKWISE,
    ]
)


class Symmetry:
    """A random symmetry for each of N samples: a mirror and an order of obstacles.

    Args:
        num_samples: N.
        num_objects: m.
        generator: Draws the symmetries.
        device: Of the samples.
    """

    def __init__(
        self,
        num_samples: int,
        num_objects: int,
        generator: np.random.Generator,
        device: torch.device,
    ) -> None:
        mirrored = generator.random(num_samples) < 0.5
        self._mirrored = torch.from_numpy(mirrored).to(device)
        self._mirrored_actions = _MIRRORED_ACTIONS.to(device)
        self._sign = torch.where(self._mirrored, -1.0, 1.0)
        obstacles = 1 + generator.random((num_samples, num_objects - 1)).argsort(axis=1)
        target = np.zeros((num_samples, 1), int)
        order = np.concatenate([target, obstacles], axis=1)
        self._order = torch.from_numpy(order).to(device)

    def states(self, states: torch.Tensor) -> torch.Tensor:
        """States (N, 3 + 3 m) seen through the symmetries."""
        poses = states.unflatten(1, (-1, 3)).clone()
        order = self._order[..., None].expand(-1, -1, 3)
        poses[:, 1:] = poses[:, 1:].gather(1, order)
        poses[..., 1:] *= self._sign[:, None, None]
        return poses.flatten(1)

    def goals(self, goals: torch.Tensor) -> torch.Tensor:
        """Goals (N, m, 2) seen through the symmetries."""
        ordered = goals.gather(1, self._order[..., None].expand(-1, -1, 2))
        return torch.stack([ordered[..., 0], ordered[..., 1] * self._sign[:, None]], -1)

    def actions(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions (N,) seen through the symmetries."""
        return torch.where(self._mirrored, self._mirrored_actions[actions], actions)

    def action_masks(self, masks: torch.Tensor) -> torch.Tensor:
        """Masks of the actions (N, 6) seen through the symmetries."""
        mirrored = masks[:, self._mirrored_actions]
        return torch.where(self._mirrored[:, None], mirrored, masks)


class NoSymmetry:
    """Leaves samples as they are; see `Symmetry`."""

    def states(self, states: torch.Tensor) -> torch.Tensor:
        """The same."""
        return states

    def goals(self, goals: torch.Tensor) -> torch.Tensor:
        """The same."""
        return goals

    def actions(self, actions: torch.Tensor) -> torch.Tensor:
        """The same."""
        return actions

    def action_masks(self, masks: torch.Tensor) -> torch.Tensor:
        """The same."""
        return masks
