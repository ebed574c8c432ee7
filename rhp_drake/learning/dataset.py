"""Demonstrations as flat arrays, which training draws its samples from."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration_files import lengths, numbers, read_table
from rhp_drake.learning.demonstration_folder import shard_paths


@dataclass(frozen=True)
class Dataset:
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
    solved: np.ndarray

    @cached_property
    def followers(self) -> np.ndarray:
        """For each transition, one of those that follow it, or -1; shape (T,)."""
        followers = np.full(len(self.search_origins), -1)
        rows = np.random.default_rng(0).permutation(len(followers))
        rows = rows[self.search_origins[rows] >= 0]
        followers[self.search_origins[rows]] = rows
        return followers


_COLUMNS: Final = (
    "initial_state",
    "goals",
    "solved",
    "actions",
    "states",
    "search_actions",
    "search_origins",
    "search_next_states",
)
# Arrays that hold indices, and the array whose rows they count.
_INDICES: Final = {
    "plan_tasks": "goals",
    "search_tasks": "goals",
    "search_origins": "search_actions",
}


def load_dataset(paths: Sequence[Path]) -> Dataset:
    """Reads files of demonstrations, and all those of folders, in order.

    Raises:
        InputError: If a file cannot be read, or there is none.
    """
    return concatenate(
        [_flatten(path, read_table(path, _COLUMNS)) for path in shard_paths(paths)]
    )


def _flatten(path: Path, table: pa.Table) -> Dataset:
    goals = numbers(table["goals"])
    if (lengths(table["states"]) != lengths(table["actions"]) + 1).any():
        raise InputError(f"{path}: a plan's states are not one more than its actions.")
    plan_lengths = lengths(table["actions"])
    num_transitions = lengths(table["search_actions"])
    # Of each task's states the last is where its plan ends.
    states = numbers(table["states"])
    before_end = np.ones(len(states), dtype=bool)
    before_end[np.cumsum(lengths(table["states"])) - 1] = False
    search_tasks = np.repeat(np.arange(table.num_rows, dtype=np.int32), num_transitions)
    next_states = numbers(table["search_next_states"])
    origins = numbers(table["search_origins"])
    first = np.repeat(np.cumsum(num_transitions) - num_transitions, num_transitions)
    origins = np.where(origins < 0, -1, origins + first).astype(np.int32)
    initial_states = numbers(table["initial_state"]).astype(np.float32)
    at_root = origins < 0
    search_states = next_states[origins]
    search_states[at_root] = initial_states[search_tasks[at_root]]
    plan_ends = np.cumsum(plan_lengths)
    return Dataset(
        goals=goals.reshape(len(goals), -1, 2),
        plan_tasks=np.repeat(np.arange(table.num_rows, dtype=np.int32), plan_lengths),
        plan_states=states[before_end],
        plan_actions=numbers(table["actions"]),
        plan_actions_left=(
            np.repeat(plan_ends, plan_lengths) - np.arange(plan_lengths.sum())
        ).astype(np.int16),
        search_tasks=search_tasks,
        search_states=search_states,
        search_actions=numbers(table["search_actions"]),
        search_next_states=next_states,
        search_origins=origins,
        solved=table["solved"].to_numpy(),
    )


def without_oldest(data: Dataset, num_transitions: int) -> Dataset:
    """The dataset without its first so many transitions; the plans stay."""
    kept = slice(num_transitions, None)
    origins = data.search_origins[kept] - num_transitions
    return replace(
        data,
        search_tasks=data.search_tasks[kept],
        search_states=data.search_states[kept],
        search_actions=data.search_actions[kept],
        search_next_states=data.search_next_states[kept],
        search_origins=np.maximum(origins, -1),
    )


def concatenate(parts: Sequence[Dataset]) -> Dataset:
    """All of them as one, in order.

    Raises:
        InputError: If they are of different numbers of objects.
    """
    if len({part.goals.shape[1] for part in parts}) > 1:
        raise InputError("the demonstrations are of different numbers of objects.")
    arrays = {}
    for field in fields(Dataset):
        values = [getattr(part, field.name) for part in parts]
        if field.name in _INDICES:
            sizes = [len(getattr(part, _INDICES[field.name])) for part in parts]
            offsets = np.cumsum([0, *sizes[:-1]], dtype=np.int32)
            values = [
                np.where(value < 0, value, value + offset)
                for value, offset in zip(values, offsets, strict=True)
            ]
        arrays[field.name] = np.concatenate(values)
    return Dataset(**arrays)


def first_plans(dataset: Dataset, num_plans: int) -> Dataset:
    """The same tasks and searches, with the first so many of the plans alone."""
    solved = dataset.solved & (np.cumsum(dataset.solved) <= num_plans)
    kept = solved[dataset.plan_tasks]
    return replace(
        dataset,
        solved=solved,
        plan_tasks=dataset.plan_tasks[kept],
        plan_states=dataset.plan_states[kept],
        plan_actions=dataset.plan_actions[kept],
        plan_actions_left=dataset.plan_actions_left[kept],
    )
