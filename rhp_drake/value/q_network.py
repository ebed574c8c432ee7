"""Q-networks: that of the paper, and one that sees the objects as a set."""

from abc import ABC, abstractmethod
from hashlib import sha256
from itertools import pairwise
import math
from typing import Any, ClassVar, Final

import numpy as np
import torch
from torch import nn

from rhp_drake.task import NUM_ACTIONS
from rhp_drake.value.features import (
    HAND_FEATURES,
    OBJECT_FEATURES,
    features,
    num_features,
    object_points,
)

HIDDEN_LAYERS: Final = (330, 180, 80, 64)  # Section VII-A.

# Of the set network; files name the architecture alone, so others need another name.
_WIDTH: Final = 192
# Wavelengths, in the features' unit of 0.1 m: from one action's way to sixteen of them.
_WAVELENGTHS: Final = (8.0, 4.0, 2.0, 1.0, 0.5)
_PHASES: Final = (0.0, math.pi / 2)


class QNetwork(nn.Module, ABC):
    """q(s, a; theta): expected return of each action, in the state, for the goals.

    Attributes:
        architecture: Its name, by which files tell networks apart.
        num_objects: m.
        any_number: Whether the same weights serve any m.
        provenance: How the weights came about: command, seeds, commit, metrics.
    """

    architecture: ClassVar[str]
    any_number: ClassVar[bool] = False

    def __init__(self, num_objects: int) -> None:
        super().__init__()
        self.num_objects = num_objects
        self.provenance: dict[str, Any] = {}

    def __repr__(self) -> str:
        """Tells networks apart: by the SHA-256 of their weights."""
        digest = sha256()
        for tensor in self.state_dict().values():
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
        name = type(self).__name__
        return f"{name}({self.num_objects}, sha256={digest.hexdigest()[:16]})"

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.parameters()).device

    @abstractmethod
    def forward(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        """Values (N, 6) for states (N, 3 + 3 m) and goals (N, m, 2)."""

    @torch.inference_mode()
    def values(self, states: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Values (N, 6) for states (N, 3 + 3 m) and one task's goals (m, 2)."""
        batch = torch.as_tensor(states, dtype=torch.float32, device=self.device)
        of_task = torch.as_tensor(goals, dtype=torch.float32, device=self.device)
        values = self(batch, of_task.expand(len(batch), -1, -1))
        return values.double().cpu().numpy()


class PaperQNetwork(QNetwork):
    """The feed-forward network of section VII-A, for one number of objects."""

    architecture = "paper"

    def __init__(self, num_objects: int) -> None:
        super().__init__(num_objects)
        widths = [num_features(num_objects), *HIDDEN_LAYERS]
        self.layers = nn.Sequential(
            *_hidden(widths), nn.Linear(widths[-1], NUM_ACTIONS)
        )

    def forward(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        """See `QNetwork`."""
        return self.layers(features(states, goals))


class SetQNetwork(QNetwork):
    """A network for any number of obstacles, in whatever order they are listed.

    One encoder sees hand and target, another one hand, target and an obstacle, each
    obstacle in turn.  A head turns the sum of all codes into values (Zaheer et al.,
    Deep Sets, 2017).  Positions enter also as their sines and cosines (Tancik et al.
    2020): values change much within a centimetre where a finger just misses a box.
    """

    architecture = "set"
    any_number = True
    _wave_numbers: torch.Tensor
    _phases: torch.Tensor

    def __init__(self, num_objects: int) -> None:
        super().__init__(num_objects)
        of_object = OBJECT_FEATURES + 4 * len(_PHASES) * len(_WAVELENGTHS)
        # A sine and a cosine of each length.
        waves = [(2 * math.pi / x, phase) for x in _WAVELENGTHS for phase in _PHASES]
        wave_numbers, phases = torch.tensor(waves).T[..., None]
        self.register_buffer("_wave_numbers", wave_numbers, persistent=False)
        self.register_buffer("_phases", phases, persistent=False)
        of_pair = 3  # The obstacle's position from the target, and its distance.
        target = HAND_FEATURES + of_object
        widths = (_WIDTH, _WIDTH)
        self.target_encoder = nn.Sequential(*_hidden([target, *widths]))
        self.obstacle_encoder = nn.Sequential(
            *_hidden([target + of_object + of_pair, *widths])
        )
        self.head = nn.Sequential(
            *_hidden([_WIDTH, _WIDTH]), nn.Linear(_WIDTH, NUM_ACTIONS)
        )

    def forward(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        """See `QNetwork`."""
        hand, of_objects = features(states, goals).tensor_split([HAND_FEATURES], dim=1)
        objects = of_objects.unflatten(1, (-1, OBJECT_FEATURES))
        points = object_points(objects)
        waves = torch.sin(self._wave_numbers * points[..., None, :] + self._phases)
        objects = torch.cat([objects, waves.flatten(2)], dim=-1)
        target, obstacles = objects.tensor_split([1], dim=1)
        hand_and_target = torch.cat([hand[:, None], target], dim=-1)
        ways = obstacles[..., :2] - target[..., :2]
        pairs = torch.cat(
            [
                hand_and_target.expand(-1, obstacles.shape[1], -1),
                obstacles,
                ways,
                torch.linalg.vector_norm(ways, dim=-1, keepdim=True),
            ],
            dim=-1,
        )
        codes = self.target_encoder(hand_and_target).squeeze(1)
        return self.head(codes + self.obstacle_encoder(pairs).sum(dim=1))


class PairQNetwork(QNetwork):
    """Two set networks: their mean; `least` their minimum."""

    architecture = "pair"
    any_number = True

    def __init__(self, num_objects: int) -> None:
        super().__init__(num_objects)
        self.members = nn.ModuleList([SetQNetwork(num_objects) for _ in range(2)])

    def forward(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        return sum(member(states, goals) for member in self.members) / 2

    def least(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        return torch.minimum(*[member(states, goals) for member in self.members])


def _hidden(widths: list[int]) -> list[nn.Module]:
    """Layers of these widths, each with its rectifier."""
    return [
        layer
        for inputs, outputs in pairwise(widths)
        for layer in (nn.Linear(inputs, outputs), nn.ReLU())
    ]


ARCHITECTURES: Final[dict[str, type[QNetwork]]] = {
    network.architecture: network for network in (PaperQNetwork, SetQNetwork, PairQNetwork)
}
