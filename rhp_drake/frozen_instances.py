"""The sets of task instances: for evaluation, and for tuning.

Those of three objects, as in the paper, are stored rather than drawn anew, so that a
change of the sampling cannot change them.  Training draws from other streams
(`random_streams`): it never meets them.
"""

from functools import cache
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


def load_instances(name: str, num_objects: int = NUM_OBJECTS) -> list[TaskInstance]:
    """The 500 instances of a set.

    Args:
        name: "evaluation", which nothing may be tuned on, or "validation".
        num_objects: m; each has a set of its own.

    Raises:
        InputError: If there is no such set.
    """
    if name not in SETS:
        raise InputError(f"{name!r} is not a set of instances: {', '.join(SETS)}.")
    if num_objects != NUM_OBJECTS:
        return list(_draw_instances(name, num_objects))
    with np.load(_FOLDER / f"{name}.npz", allow_pickle=False) as arrays:
        return [
            TaskInstance(state, goals)
            for state, goals in zip(
                arrays["initial_states"], arrays["goals"], strict=True
            )
        ]


@cache
def _draw_instances(name: str, num_objects: int) -> tuple[TaskInstance, ...]:
    return tuple(
        sample_instance(stream(_SEED, name, "objects", num_objects, i), num_objects)
        for i in range(SET_SIZE)
    )


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
