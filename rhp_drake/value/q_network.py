"""The Q-network of section VII-A, and its files.

A file is in the safetensors format, which cannot execute code; its metadata says
what the weights are for and where they come from.
"""

from hashlib import sha256
from itertools import pairwise
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
import torch
from torch import nn

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.task import NUM_ACTIONS
from rhp_drake.value.features import features, num_features

HIDDEN_LAYERS: Final = (330, 180, 80, 64)  # Section VII-A.
_FORMAT: Final = "rhp_drake q_network 1"


class QNetwork(nn.Module):
    """q(s, a; theta): expected return of each action, in the state, for the goals.

    Attributes:
        num_objects: m, which the weights are for.
        provenance: How the weights came about: command, seeds, commit, metrics.
    """

    def __init__(self, num_objects: int) -> None:
        super().__init__()
        self.num_objects = num_objects
        self.provenance: dict[str, Any] = {}
        widths = [num_features(num_objects), *HIDDEN_LAYERS]
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        layers.append(nn.Linear(widths[-1], NUM_ACTIONS))
        self.layers = nn.Sequential(*layers)

    def __repr__(self) -> str:
        """Tells networks apart: by the SHA-256 of their weights."""
        digest = sha256()
        for tensor in self.state_dict().values():
            digest.update(tensor.cpu().contiguous().numpy().tobytes())
        return f"QNetwork({self.num_objects}, sha256={digest.hexdigest()[:16]})"

    def forward(self, states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
        """Values (N, 6) for states (N, 3 + 3 m) and goals (N, m, 2)."""
        return self.layers(features(states, goals))

    @torch.inference_mode()
    def values(self, states: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Values (N, 6) for states (N, 3 + 3 m) and one task's goals (m, 2)."""
        batch = torch.as_tensor(states, dtype=torch.float32)
        of_task = torch.as_tensor(goals, dtype=torch.float32)
        return self(batch, of_task.expand(len(batch), -1, -1)).double().numpy()

    def save(self, path: Path) -> None:
        """Writes the weights and their provenance."""
        metadata = {
            "format": _FORMAT,
            "num_objects": str(self.num_objects),
            "provenance": json.dumps(self.provenance),
        }
        tensors = {k: v.contiguous().cpu() for k, v in self.state_dict().items()}
        write_atomically(path, save(tensors, metadata))


def load_q_network(path: Path, num_objects: int) -> QNetwork:
    """Reads a Q-network for `num_objects` objects.

    Raises:
        InputError: If the file is missing, corrupt, or for another m.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file of weights.") from error
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a readable file of weights ({error})."
        ) from error
    if metadata.get("format") != _FORMAT:
        raise InputError(f"{path}: not the weights of a Q-network of this version.")
    if metadata.get("num_objects") != str(num_objects):
        raise InputError(
            f"{path}: the weights are for {metadata.get('num_objects')} objects, not "
            f"{num_objects}."
        )
    network = QNetwork(num_objects)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path}: the weights have the wrong shapes.") from error
    network.provenance = json.loads(metadata.get("provenance", "{}"))
    return network.eval()
