"""A folder of demonstrations that many workers fill, and that survives their death.

A task is written to a file of its own as soon as it is done; the tasks of a shard
become one file as soon as all of them are, or work stops.  Work killed at any moment
goes on where it was, with no task lost and none twice; and since a task depends on its
number alone, the folder comes out the same, `seconds` aside, whoever worked on it.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from functools import partial
from hashlib import sha256
import logging
from pathlib import Path
import time
from typing import Any, Final

import pyarrow as pa

from rhp_drake.errors import InputError
from rhp_drake.files import exclusive, make_folder
from rhp_drake.learning.demonstration import (
    Demonstration,
    Demonstrator,
    training_task,
)
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
from rhp_drake.planning.search import SearchRecord
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.workers import Workers, run_over

_logger = logging.getLogger("rhp_drake")

TASKS_PER_SHARD: Final = 100
# Readers of Parquet folders skip names that begin with an underscore.
_SINGLE: Final = "_single"


def demonstrate_tasks(
    folder: Path,
    tasks: range,
    demonstrator: Demonstrator,
    workers: Workers,
    commit: str = "unknown",
) -> Iterator[int]:
    """Does those tasks that `folder` lacks.

    Args:
        folder: Made if need be; it may hold other tasks of the same demonstrator.
        tasks: Their numbers.
        demonstrator: The one whose work the folder holds, if it holds any.
        workers: Who does it.
        commit: Of the code, to be noted.

    Yields:
        The number of tasks done, at the beginning and after each.

    Raises:
        InputError: If the folder holds the work of another demonstrator, a file of it
            cannot be read, or another process works there.
        WorkError: If a worker dies or a file cannot be written; nothing is lost.
    """
    with exclusive(folder):
        make_folder(folder / _SINGLE)
        _join_singles(folder)
        _check_demonstrator(folder, demonstrator)
        missing = set(tasks) - _tasks_done(folder)
        yield len(tasks) - len(missing)
        work = partial(_demonstrate, demonstrator=demonstrator)
        details = {"demonstrator": repr(demonstrator), "commit": commit}
        try:
            for task, done in run_over(work, sorted(missing), workers):
                if done.failure:
                    _logger.warning("task %d is left out: %s", task, done.failure)
                write_table(_single_path(folder, task), to_table([done], details))
                missing.remove(task)
                begin = task // TASKS_PER_SHARD * TASKS_PER_SHARD
                if missing.isdisjoint(range(begin, begin + TASKS_PER_SHARD)):
                    _join_singles(folder)
                yield len(tasks) - len(missing)
        finally:
            _join_singles(folder)


def _check_demonstrator(folder: Path, demonstrator: Demonstrator) -> None:
    for path in sorted(folder.glob("tasks_*.parquet"))[:1]:
        known = describe(path)["demonstrator"]
        if known != repr(demonstrator):
            raise InputError(
                f"{folder} holds the work of {known}, not of {demonstrator!r}."
            )


# A process keeps its demonstrator from task to task, because its push model is dear.
_residents: dict[str, Demonstrator] = {}


def _demonstrate(task: int, demonstrator: Demonstrator) -> Demonstration:
    begin = time.perf_counter()
    try:
        key = repr(demonstrator)
        if key not in _residents:
            _residents.clear()
            # A copy: the original is sent to others without what this one gathers.
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
    shards: dict[Path, list[Path]] = {}
    for path in sorted((folder / _SINGLE).glob("task_*.parquet")):
        try:
            (task,) = _tasks(read_table(path))
        except InputError as error:
            _logger.warning("%s  The task is done again.", error)
            path.unlink()
            continue
        shards.setdefault(_shard_path(folder, task), []).append(path)
    for shard, paths in shards.items():
        sources = [shard, *paths] if shard.exists() else paths
        # A task is in both if work was killed between the next two steps.
        write_table(shard, join_tables([read_table(path) for path in sources]))
        for path in paths:
            path.unlink()


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
    """What a file or the first one of a folder says of itself, and which tasks it has.

    Returns:
        See `demonstration_files.about`; "tasks", how many, and "sha256" of tasks and
        plans.
    """
    tables = [read_table(shard, COMPACT_COLUMNS) for shard in shard_paths([path])]
    digest = sha256()
    for table in tables:
        for name in ("seed", "task"):
            digest.update(table[name].to_numpy().tobytes())
        digest.update(lengths(table["actions"]).tobytes())
        digest.update(numbers(table["actions"]).tobytes())
    tasks = sum(table.num_rows for table in tables)
    return about(tables[0]) | {"tasks": tasks, "sha256": digest.hexdigest()}
