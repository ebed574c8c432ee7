"""The sets of task instances: for evaluation, and for tuning.

Those of three objects, as in the paper, are stored rather than drawn anew, so that a
change of the sampling cannot change them.  Training draws from other streams
(`random_streams`): it never meets them.
"""

from collections.abc import Sequence
from functools import cache
import io
from pathlib import Path
from typing import Final, overload

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


def load_instances(name: str, num_objects: int = NUM_OBJECTS) -> Sequence[TaskInstance]:
    """The 500 instances of a set; those that are not stored are drawn one by one.

    Args:
        name: "evaluation", which nothing may be tuned on, or "validation".
        num_objects: m; each has a set of its own.

    Raises:
        InputError: If there is no such set; as an instance is asked for, if so many
            objects do not fit.
    """
    if name not in SETS:
        raise InputError(f"{name!r} is not a set of instances: {', '.join(SETS)}.")
    if num_objects != NUM_OBJECTS:
        return _DrawnInstances(name, num_objects)
    with np.load(_FOLDER / f"{name}.npz", allow_pickle=False) as arrays:
        return [
            TaskInstance(state, goals)
            for state, goals in zip(
                arrays["initial_states"], arrays["goals"], strict=True
            )
        ]


class _DrawnInstances(Sequence[TaskInstance]):
    """A set whose instances are drawn when they are asked for."""

    def __init__(self, name: str, num_objects: int) -> None:
        self._name = name
        self._num_objects = num_objects

    def __len__(self) -> int:
        return SET_SIZE

    @overload
    def __getitem__(self, index: int) -> TaskInstance: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[TaskInstance]: ...

    def __getitem__(self, index: int | slice) -> TaskInstance | Sequence[TaskInstance]:
        asked = range(SET_SIZE)[index]
        if isinstance(asked, range):
            return [self[i] for i in asked]
        return _draw_instance(self._name, self._num_objects, asked)


@cache
def _draw_instance(name: str, num_objects: int, index: int) -> TaskInstance:
    generator = stream(_SEED, name, "objects", num_objects, index)
    return sample_instance(generator, num_objects)


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
