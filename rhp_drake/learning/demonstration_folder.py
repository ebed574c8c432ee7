"""A folder of demonstrations that many workers fill, and that survives their death.

A task is written to a file of its own as soon as it is done; the tasks of a shard
become one file as soon as all of them are, or work stops.  Work killed at any moment
goes on where it was, with no task lost and none twice; and since a task depends on its
number alone, the folder comes out the same, `seconds` aside, whoever worked on it.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from functools import partial
import json
import logging
from pathlib import Path
import time
from typing import Any, Final

import pyarrow as pa

from rhp_drake.errors import InputError
from rhp_drake.files import make_folder, write_atomically
from rhp_drake.learning.demonstration import (
    Demonstration,
    Demonstrator,
    training_task,
)
from rhp_drake.learning.demonstration_files import (
    about,
    read_table,
    to_table,
    write_table,
)
from rhp_drake.planning.search import SearchRecord
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.workers import Workers, run_over

_logger = logging.getLogger("rhp_drake")

TASKS_PER_SHARD: Final = 100
# Readers of Parquet folders skip names that begin with an underscore.
_DESCRIPTION: Final = "_demonstrator.json"
_SINGLE: Final = "_single"


def demonstrate_tasks(
    folder: Path,
    num_tasks: int,
    demonstrator: Demonstrator,
    workers: Workers,
    commit: str = "unknown",
) -> Iterator[int]:
    """Does those of the demonstrator's first `num_tasks` tasks that `folder` lacks.

    Args:
        folder: Made if need be.
        num_tasks: May be more, or fewer, than at an earlier time.
        demonstrator: The one whose work the folder holds, if it holds any.
        workers: Who does it.
        commit: Of the code, to be noted.

    Yields:
        The number of tasks done, at the beginning and after each.

    Raises:
        InputError: If the folder holds the work of another demonstrator, or a file of
            it cannot be read.
    """
    make_folder(folder / _SINGLE)
    description = {"demonstrator": repr(demonstrator)}
    known = _read_description(folder)
    if known not in ({}, description):
        raise InputError(f"{folder} holds the work of {known}.")
    write_atomically(folder / _DESCRIPTION, json.dumps(description) + "\n")
    _join_singles(folder)

    first = demonstrator.first_task
    tasks = range(first, first + num_tasks)
    missing = set(tasks) - _tasks_done(folder)
    yield num_tasks - len(missing)
    work = partial(_demonstrate, demonstrator=demonstrator)
    try:
        for task, done in run_over(work, sorted(missing), workers):
            if done.failure:
                _logger.warning("task %d is left out: %s", task, done.failure)
            table = to_table([done], description | {"commit": commit})
            write_table(_single_path(folder, task), table)
            missing.remove(task)
            begin = task // TASKS_PER_SHARD * TASKS_PER_SHARD
            if missing.isdisjoint(range(begin, begin + TASKS_PER_SHARD)):
                _join_singles(folder)
            yield num_tasks - len(missing)
    finally:
        _join_singles(folder)


# A process keeps its demonstrator from task to task, because its push model is dear.
_residents: dict[str, Demonstrator] = {}


def _demonstrate(task: int, demonstrator: Demonstrator) -> Demonstration:
    begin = time.perf_counter()
    try:
        key = repr(demonstrator)
        if key not in _residents:
            # A copy: with a push model, the original could not be sent any more.
            _residents[key] = copy(demonstrator)
        return _residents[key].demonstrate(task)
    except PushModelError as error:
        # One state that the solver cannot handle must not stop days of work.
        instance = training_task(demonstrator.seed, task, demonstrator.num_objects)
        state = instance.initial_state
        return Demonstration(
            seed=demonstrator.seed,
            task=task,
            instance=instance,
            actions=None,
            states=state[None],
            search=SearchRecord(len(state)).search(),
            seconds=time.perf_counter() - begin,
            failure=str(error),
        )


def _shard_path(folder: Path, task: int) -> Path:
    return folder / f"tasks_{task // TASKS_PER_SHARD * TASKS_PER_SHARD:07d}.parquet"


def _single_path(folder: Path, task: int) -> Path:
    return folder / _SINGLE / f"task_{task:07d}.parquet"


def _tasks(table: pa.Table) -> list[int]:
    return table["task"].to_pylist()


def _tasks_done(folder: Path) -> set[int]:
    paths = folder.glob("tasks_*.parquet")
    return {task for path in paths for task in _tasks(read_table(path, ["task"]))}


def _join_singles(folder: Path) -> None:
    """Moves the tasks that have files of their own to their shards."""
    singles = sorted((folder / _SINGLE).glob("task_*.parquet"))
    shards: dict[Path, list[Path]] = {}
    for path in singles:
        task = int(path.stem.removeprefix("task_"))
        shards.setdefault(_shard_path(folder, task), []).append(path)
    for shard, paths in shards.items():
        sources = [shard, *paths] if shard.exists() else paths
        # A task is in both if work was killed between the next two steps.
        rows = {
            task: table.slice(row, 1)
            for table in map(read_table, sources)
            for row, task in enumerate(_tasks(table))
        }
        table = pa.concat_tables([rows[task] for task in sorted(rows)])
        write_table(shard, table.combine_chunks())
        for path in paths:
            path.unlink()


def _read_description(folder: Path) -> dict[str, str]:
    path = folder / _DESCRIPTION
    if not path.exists():
        return {}
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable description ({error}).") from error


def shard_paths(paths: Sequence[Path]) -> list[Path]:
    """The files of demonstrations among `paths`, and those in folders among them.

    Raises:
        InputError: If one of them is none, or holds none.
    """
    found = []
    for path in paths:
        shards = sorted(path.glob("tasks_*.parquet")) if path.is_dir() else [path]
        if not shards:
            raise InputError(f"{path} holds no demonstrations (tasks_*.parquet).")
        found += shards
    return found


def describe(path: Path) -> dict[str, Any]:
    """What a file, or the first one of a folder, says of itself: see `about`."""
    return about(read_table(shard_paths([path])[0], ["task"]))
