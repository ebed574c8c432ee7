"""The frozen sets of task instances: for evaluation, and for tuning.

They are stored rather than drawn anew, so that a change of the sampling cannot change
them.  Training draws from other streams (`random_streams`): it never meets them.
"""

import io
from pathlib import Path
from typing import Final

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.random_streams import EVALUATION, VALIDATION, stream
from rhp_drake.task import TaskInstance, sample_instance

SETS: Final = (VALIDATION, EVALUATION)
SET_SIZE: Final = 500
NUM_OBJECTS: Final = 3
_SEED: Final = 0
_FOLDER: Final = Path(__file__).resolve().parent / "data"


def load_instances(name: str) -> list[TaskInstance]:
    """The 500 instances, of three objects each, of a set.

    Args:
        name: "evaluation", which nothing may be tuned on, or "validation".

    Raises:
        InputError: If there is no such set.
    """
    if name not in SETS:
        raise InputError(f"{name!r} is not a set of instances: {', '.join(SETS)}.")
    with np.load(_FOLDER / f"{name}.npz", allow_pickle=False) as arrays:
        return [
            TaskInstance(state, goals)
            for state, goals in zip(
                arrays["initial_states"], arrays["goals"], strict=True
            )
        ]


def freeze_instances(name: str, folder: Path = _FOLDER) -> None:
    """Draws a set and stores it; how the files in the repository were made."""
    instances = [
        sample_instance(stream(_SEED, name, i), NUM_OBJECTS) for i in range(SET_SIZE)
    ]
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        initial_states=np.array([i.initial_state for i in instances]),
        goals=np.array([i.goals for i in instances]),
    )
    write_atomically(folder / f"{name}.npz", buffer.getvalue())
