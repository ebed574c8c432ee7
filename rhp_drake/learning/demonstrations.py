"""Demonstrations: plans of the kinodynamic RRT and the trees they grew in, as files.

A folder holds shards of `PLANS_PER_SHARD` plans each.  A shard depends on the seed
and its index alone, and is written whole or not at all: work that was interrupted
goes on where it stopped, whatever the number of workers.

A shard is an NPZ file of the arrays that `Demonstrations` describes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial
import io
from pathlib import Path
import re
from typing import Final
import zipfile

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.task import sample_instance
from rhp_drake.workers import run_over

PLANS_PER_SHARD: Final = 25
# A task not solved with this many simulated actions yields its tree but no plan.
MAX_TRANSITIONS: Final = 6000


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


def demonstrate(push_model: PushModel, seed: int, index: int) -> Demonstrations:
    """Plans for training task number `index` under `seed`."""
    instance = sample_instance(stream(seed, TRAINING, index), push_model.num_objects)
    found = plan(
        push_model,
        instance.initial_state,
        instance.goals,
        stream(seed, TRAINING, index, "kinodynamic_rrt"),
        max_transitions=MAX_TRANSITIONS,
    )
    solved = found.actions is not None
    actions = found.actions if found.actions is not None else np.empty(0, int)
    search = found.search
    return Demonstrations(
        goals=instance.goals[None],
        plan_tasks=np.zeros(len(actions), np.int32),
        plan_states=found.states[: len(actions)].astype(np.float32),
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


def _make_shard(shard: int, folder: Path, seed: int, num_objects: int) -> int:
    push_model = PushModel(num_objects)
    first = shard * PLANS_PER_SHARD
    demonstrations = _concatenate(
        [
            demonstrate(push_model, seed, index)
            for index in range(first, first + PLANS_PER_SHARD)
        ]
    )
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **vars(demonstrations))
    write_atomically(_shard_path(folder, shard), buffer.getvalue())
    return int(demonstrations.solved.sum())


def _shard_path(folder: Path, shard: int) -> Path:
    return folder / f"plans_{shard:05d}.npz"


def make_demonstrations(
    folder: Path, num_plans: int, seed: int, num_objects: int, num_workers: int
) -> Iterator[int]:
    """Makes the shards that `num_plans` tasks need and `folder` lacks.

    Yields:
        The number of tasks done, after each shard.
    """
    shards = range(-(-num_plans // PLANS_PER_SHARD))
    missing = [shard for shard in shards if not _shard_path(folder, shard).exists()]
    done = (len(shards) - len(missing)) * PLANS_PER_SHARD
    yield done
    make = partial(_make_shard, folder=folder, seed=seed, num_objects=num_objects)
    for _ in run_over(make, missing, num_workers):
        done += PLANS_PER_SHARD
        yield done


def load_demonstrations(folder: Path, num_plans: int | None = None) -> Demonstrations:
    """Reads a folder's shards, in order.

    Args:
        folder: Made by `make_demonstrations`.
        num_plans: How many tasks to read, all of them if None.

    Raises:
        InputError: If a shard cannot be read, or there are not enough.
    """
    paths = sorted(
        path
        for path in folder.glob("plans_*.npz")
        if re.fullmatch(r"plans_\d{5}\.npz", path.name)
    )
    if num_plans is not None:
        needed = -(-num_plans // PLANS_PER_SHARD)
        if len(paths) < needed:
            raise InputError(
                f"{folder} holds {len(paths) * PLANS_PER_SHARD} plans, not {num_plans}."
            )
        paths = paths[:needed]
    if not paths:
        raise InputError(f"{folder} holds no demonstrations (plans_*.npz).")
    names = {field.name for field in fields(Demonstrations)}
    parts = []
    for path in paths:
        try:
            with np.load(path, allow_pickle=False) as arrays:
                parts.append(Demonstrations(**{name: arrays[name] for name in names}))
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise InputError(f"{path}: not a readable shard ({error}).") from error
    return _concatenate(parts)
