"""Stored plans, executed again: to check them, and to rebuild what was not stored.

The push model is deterministic.  So seed, number and actions of a task are enough to
rebuild its states; a file of these columns alone, the compact form, takes some ten
bytes a plan.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
import logging
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration import Demonstration, training_task
from rhp_drake.learning.demonstration_files import (
    COMPACT_COLUMNS,
    about,
    join_tables,
    lengths,
    numbers,
    read_table,
    to_table,
    write_table,
)
from rhp_drake.planning.search import chain
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.task import goals_reached
from rhp_drake.workers import run_over

_logger = logging.getLogger("rhp_drake")

# Those that come with the package, in compact form.
SHIPPED_PLANS: Final = Path(__file__).resolve().parent.parent / "data/plans.parquet"


@dataclass(frozen=True)
class Replay:
    """What came of the plans of one file.

    Attributes:
        num_plans: Solved tasks in the file.
        reached: How many of them reach the goal again.
        identical: How many of them pass through the stored states, bit for bit in
            their single precision; None where none are stored.
    """

    num_plans: int
    reached: int
    identical: int | None


def verify(paths: Sequence[Path], num_workers: int) -> Iterator[Replay]:
    """Executes the plans of some files again, and yields a file's result at a time.

    Raises:
        InputError: If a file cannot be read; the message names it.
    """
    for _, replay in run_over(_verify, paths, num_workers):
        yield replay


def _verify(path: Path) -> Replay:
    table = read_table(path)
    rebuilt = _rebuild(table)
    solved = [d for d in rebuilt if d.actions is not None]
    reached = sum(goals_reached(d.states[-1], d.instance.goals) for d in solved)
    if "states" not in table.column_names:
        return Replay(len(solved), int(reached), None)
    ends = np.cumsum(lengths(table["states"]))
    stored = np.split(numbers(table["states"]), ends[:-1])
    identical = sum(
        d.actions is not None and np.array_equal(d.states.astype(np.float32), states)
        for d, states in zip(rebuilt, stored, strict=True)
    )
    return Replay(len(solved), int(reached), int(identical))


def compact(paths: Sequence[Path], out: Path) -> int:
    """Writes the compact form of the plans in some files; returns how many.

    Raises:
        InputError: If a file cannot be read; the message names it.
    """
    table = join_tables([read_table(path, COMPACT_COLUMNS) for path in paths])
    table = table.filter(table["solved"])
    write_table(out, table)
    return table.num_rows


def rebuild(path: Path, out: Path) -> int:
    """Writes demonstrations with states from the compact form.

    Their searches hold the transitions of the plans alone.  Plans that do not reach
    their goals again are left out.

    Returns:
        The number of plans.

    Raises:
        InputError: If the file cannot be read, or holds no plans.
    """
    table = read_table(path, COMPACT_COLUMNS)
    rebuilt = [
        d for d in _rebuild(table) if goals_reached(d.states[-1], d.instance.goals)
    ]
    if not rebuilt:
        raise InputError(f"{path}: holds no plans that reach their goals.")
    if lost := table.num_rows - len(rebuilt):
        # Another machine or version of Drake may end a push a hair's breadth elsewhere.
        _logger.warning("%s: %d plans miss their goals and are left out", path, lost)
    details = {k: v for k, v in about(table).items() if k in ("demonstrator", "commit")}
    write_table(out, to_table(rebuilt, details))
    return len(rebuilt)


@cache
def _push_model(num_objects: int) -> PushModel:
    return PushModel(num_objects)


def _rebuild(table: pa.Table) -> list[Demonstration]:
    """Demonstrations, all plans executed side by side."""
    num_objects = about(table)["num_objects"]
    push_model = _push_model(num_objects)
    seeds, tasks = table["seed"].to_pylist(), table["task"].to_pylist()
    instances = [
        training_task(seed, task, num_objects)
        for seed, task in zip(seeds, tasks, strict=True)
    ]
    num_actions = lengths(table["actions"])
    actions = np.split(numbers(table["actions"]).astype(int), np.cumsum(num_actions))
    states = [[instance.initial_state] for instance in instances]
    for k in range(int(num_actions.max(initial=0))):
        # Plans end, and at an action that the push model refuses they stop.
        rows = [r for r, s in enumerate(states) if len(s) == k + 1 <= num_actions[r]]
        if not rows:
            break
        present = np.array([states[row][-1] for row in rows])
        following = _step(push_model, present, np.array([actions[r][k] for r in rows]))
        for row, state in zip(rows, following, strict=True):
            if np.isfinite(state).all():
                states[row].append(state)
    solved = table["solved"].to_pylist()
    return [
        Demonstration(
            seed=seeds[row],
            task=tasks[row],
            instance=instances[row],
            actions=actions[row] if solved[row] else None,
            states=np.array(states[row]),
            # As far as its states go.
            search=chain(np.array(states[row]), actions[row][: len(states[row]) - 1]),
            seconds=0.0,
        )
        for row in range(table.num_rows)
    ]


def _step(push_model: PushModel, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """`PushModel.step`, with nan where it refuses a state."""
    try:
        return push_model.step(states, actions)
    except PushModelError:
        if len(states) == 1:
            return np.full_like(states, np.nan)
    half = len(states) // 2
    return np.concatenate(
        [
            _step(push_model, states[:half], actions[:half]),
            _step(push_model, states[half:], actions[half:]),
        ]
    )
