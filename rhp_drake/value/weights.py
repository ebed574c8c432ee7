"""Files of a Q-network's weights.

A file is in the safetensors format, which cannot execute code; its metadata says
what the weights are for and where they come from.
"""

import json
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.value.q_network import ARCHITECTURES, QNetwork

_FORMAT: Final = "rhp_drake q_network 1"
_ANY_NUMBER: Final = "any"


def save_q_network(network: QNetwork, path: Path) -> None:
    """Writes the weights and their provenance."""
    number = _ANY_NUMBER if network.any_number else str(network.num_objects)
    metadata = {
        "format": _FORMAT,
        "architecture": network.architecture,
        "num_objects": number,
        "provenance": json.dumps(network.provenance),
    }
    tensors = {k: v.contiguous().cpu() for k, v in network.state_dict().items()}
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
    # Files from before there were two do not say which.
    architecture = ARCHITECTURES.get(metadata.get("architecture", "paper"))
    if architecture is None:
        raise InputError(
            f"{path}: the weights of an unknown network, {metadata['architecture']!r}."
        )
    expected = _ANY_NUMBER if architecture.any_number else str(num_objects)
    if metadata.get("num_objects") != expected:
        raise InputError(
            f"{path}: the weights are for {metadata.get('num_objects')} objects, not "
            f"{num_objects}."
        )
    network = architecture(num_objects)
    try:
        network.load_state_dict(tensors)
    except RuntimeError as error:
        raise InputError(f"{path}: the weights have the wrong shapes.") from error
    network.provenance = json.loads(metadata.get("provenance", "{}"))
    return network.eval()
