"""Demonstrations: plans, and all that was simulated to find them, as files.

A folder holds shards of `PLANS_PER_SHARD` plans each.  A shard depends on the
demonstrator and its index alone, and is written whole or not at all: work that was
interrupted goes on where it stopped, whatever the number of workers.

A shard is an NPZ file of the arrays that `Demonstrations` describes; the file
`demonstrator.json` says who made them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
import io
import json
import logging
from pathlib import Path
import re
from typing import Final, Protocol
import zipfile

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.planning.search import Search
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.workers import run_over

_logger = logging.getLogger("rhp_drake")

PLANS_PER_SHARD: Final = 25


@dataclass(frozen=True)
class Demonstrations:
    """P tasks, their plans, and all T transitions that were simulated for them.

    Attributes:
        goals: Goals of each task, shape (P, m, 2).
        plan_tasks: For each state-action pair on a plan, its task, shape (L,).
        plan_states: Shape (L, 3 + 3 m).
        plan_actions: Shape (L,).
        plan_actions_left: Actions to the goal, L - l of Eq. 2, at least 1; shape (L,).
        search_tasks: For each transition, its task, shape (T,).
        search_states: Shape (T, 3 + 3 m).
        search_actions: Shape (T,).
        search_next_states: Shape (T, 3 + 3 m).
        search_origins: For each transition, which one led to its state; -1 at a root.
        num_transitions: Of each task's search, shape (P,).
        solved: Whether each task has a plan, shape (P,).
    """

    goals: np.ndarray
    plan_tasks: np.ndarray
    plan_states: np.ndarray
    plan_actions: np.ndarray
    plan_actions_left: np.ndarray
    search_tasks: np.ndarray
    search_states: np.ndarray
    search_actions: np.ndarray
    search_next_states: np.ndarray
    search_origins: np.ndarray
    num_transitions: np.ndarray
    solved: np.ndarray


_DESCRIPTION: Final = "demonstrator.json"

# Arrays that hold indices, and the array whose rows they count.
_INDICES: Final = {
    "plan_tasks": "goals",
    "search_tasks": "goals",
    "search_origins": "search_actions",
}


def _concatenate(parts: list[Demonstrations]) -> Demonstrations:
    arrays = {}
    for field in fields(Demonstrations):
        values = [getattr(part, field.name) for part in parts]
        if field.name in _INDICES:
            lengths = [len(getattr(part, _INDICES[field.name])) for part in parts]
            offsets = np.cumsum([0, *lengths[:-1]], dtype=np.int32)
            values = [
                np.where(value < 0, value, value + offset)
                for value, offset in zip(values, offsets, strict=True)
            ]
        arrays[field.name] = np.concatenate(values)
    return Demonstrations(**arrays)


class Demonstrator(Protocol):
    """Whoever solves training tasks; it is sent to other processes."""

    def demonstrate(self, index: int) -> Demonstrations:
        """Solves task number `index`, or fails to; depends on nothing else."""
        ...


def make_demonstration(
    goals: np.ndarray, actions: np.ndarray | None, states: np.ndarray, search: Search
) -> Demonstrations:
    """What came of one task.

    Args:
        goals: Shape (m, 2).
        actions: Those that led to the goal, shape (L,); None if none did.
        states: Where they were taken, shape (L, 3 + 3 m) or more.
        search: All that was simulated.
    """
    solved = actions is not None
    actions = actions if actions is not None else np.empty(0, int)
    return Demonstrations(
        goals=goals[None],
        plan_tasks=np.zeros(len(actions), np.int32),
        plan_states=states[: len(actions)].astype(np.float32),
        plan_actions=actions.astype(np.int8),
        plan_actions_left=np.arange(len(actions), 0, -1, dtype=np.int16),
        search_tasks=np.zeros(len(search.actions), np.int32),
        search_states=search.states.astype(np.float32),
        search_actions=search.actions.astype(np.int8),
        search_next_states=search.next_states.astype(np.float32),
        search_origins=search.origins.astype(np.int32),
        num_transitions=np.array([len(search.actions)]),
        solved=np.array([solved]),
    )


def _make_shard(shard: int, folder: Path, demonstrator: Demonstrator) -> int:
    parts = []
    first = shard * PLANS_PER_SHARD
    for index in range(first, first + PLANS_PER_SHARD):
        try:
            parts.append(demonstrator.demonstrate(index))
        except PushModelError as error:
            # One state that the solver cannot handle must not stop days of work.
            _logger.warning("task %d is left out: %s", index, error)
    if not parts:
        raise PushModelError(f"all tasks of shard {shard} failed.")
    demonstrations = _concatenate(parts)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **vars(demonstrations))
    write_atomically(_shard_path(folder, shard), buffer.getvalue())
    return int(demonstrations.solved.sum())


def _shard_path(folder: Path, shard: int) -> Path:
    return folder / f"plans_{shard:05d}.npz"


def make_demonstrations(
    folder: Path, num_plans: int, demonstrator: Demonstrator, num_workers: int
) -> Iterator[int]:
    """Makes the shards that `num_plans` tasks need and `folder` lacks.

    Yields:
        The number of tasks done, after each shard.

    Raises:
        InputError: If the folder holds the work of another demonstrator.
    """
    description = {"demonstrator": repr(demonstrator)}
    if read_description(folder) not in ({}, description):
        raise InputError(f"{folder} holds the work of {read_description(folder)}.")
    write_atomically(folder / _DESCRIPTION, json.dumps(description) + "\n")
    shards = range(-(-num_plans // PLANS_PER_SHARD))
    missing = [shard for shard in shards if not _shard_path(folder, shard).exists()]
    done = (len(shards) - len(missing)) * PLANS_PER_SHARD
    yield done
    make = partial(_make_shard, folder=folder, demonstrator=demonstrator)
    for _ in run_over(make, missing, num_workers):
        done += PLANS_PER_SHARD
        yield done


def read_description(folder: Path) -> dict[str, str]:
    """Who made a folder's demonstrations; empty if it does not say."""
    path = folder / _DESCRIPTION
    if not path.exists():
        return {}
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{path}: not a readable description ({error}).") from error


def load_demonstrations(folders: Sequence[Path]) -> Demonstrations:
    """Reads the shards of some folders, in order.

    Raises:
        InputError: If a shard cannot be read, or a folder has none.
    """
    names = {field.name for field in fields(Demonstrations)}
    parts = []
    for folder in folders:
        paths = sorted(
            path
            for path in folder.glob("plans_*.npz")
            if re.fullmatch(r"plans_\d{5}\.npz", path.name)
        )
        if not paths:
            raise InputError(f"{folder} holds no demonstrations (plans_*.npz).")
        for path in paths:
            try:
                with np.load(path, allow_pickle=False) as arrays:
                    parts.append(Demonstrations(**{n: arrays[n] for n in names}))
            except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
                raise InputError(f"{path}: not a readable shard ({error}).") from error
    return _concatenate(parts)
