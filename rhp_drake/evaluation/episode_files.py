"""Files of episodes: a row each, in Parquet.

| column | type | what |
| --- | --- | --- |
| `policy`, `weights` | string | who decided, and its Q-network; "" if it has none |
| `level` | string | of the physics' uncertainty: none, low, medium, high |
| `instance` | int32 | which of the set |
| `trial` | int32 | which of the trials on this instance; each has physics of its own |
| `outcome` | string | "succeeded", or why it failed |
| `succeeded` | bool | whether all objects ended in their goal regions |
| `num_actions` | int32 | L, actions executed |
| `actions` | list of int8 | the actions, `task.Action` |
| `states` | list of float[3 + 3 m] | before each action and at the end |
| `decision_seconds` | list of float | computation of each decision |
| `world_seconds` | double | computation of the world |
| `simulated_seconds` | double | how long it took in the world; 0 without time |
| `ending` | string | of a failure: what was outside its goal region, and loops |

All but `decision_seconds` and `world_seconds` depend on the experiment alone, as long
as no run and no search reaches its limit of computation.  The metadata of each file
have the key "rhp_drake": JSON with commit of the code and machine.
"""

from collections.abc import Iterator, Sequence
import json
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import Column, Trial
from rhp_drake.learning.demonstration_files import lengths, numbers, write_table

_METADATA_KEY: Final = b"rhp_drake"


def write_episodes(
    path: Path,
    trials: Sequence[Trial],
    episodes: Sequence[Episode],
    about: dict[str, str],
) -> None:
    """Writes at least one episode and the trial of each, whole or not at all.

    Args:
        path: The file.
        trials: What was run.
        episodes: What became of it.
        about: Commit of the code and machine, for the metadata.

    Raises:
        WorkError: If the file cannot be written.
    """
    write_table(path, _to_table(trials, episodes, about))


def read_episodes(
    path: Path,
) -> tuple[list[tuple[Trial, Episode]], dict[str, str]]:
    """Reads a file: its episodes, and what is noted about them.

    Raises:
        InputError: If it is damaged or something else; the message names it.
    """
    table = _read_table(path)
    about = json.loads(table.schema.metadata[_METADATA_KEY])
    return list(_from_table(table)), about


def num_episodes(path: Path) -> int:
    """How many episodes a file holds, 0 if it is not there.

    Raises:
        InputError: If it is damaged or something else; the message names it.
    """
    return _read_table(path).num_rows if path.exists() else 0


def _schema(num_values: int, about: dict[str, str]) -> pa.Schema:
    """The columns described above, for states of so many values."""
    return pa.schema(
        {
            "policy": pa.string(),
            "weights": pa.string(),
            "level": pa.string(),
            "instance": pa.int32(),
            "trial": pa.int32(),
            "outcome": pa.string(),
            "succeeded": pa.bool_(),
            "num_actions": pa.int32(),
            "actions": pa.list_(pa.int8()),
            "states": pa.list_(pa.list_(pa.float32(), num_values)),
            "decision_seconds": pa.list_(pa.float32()),
            "world_seconds": pa.float64(),
            "simulated_seconds": pa.float64(),
            "ending": pa.string(),
        },
        metadata={_METADATA_KEY: json.dumps(about).encode()},
    )


def _to_table(
    trials: Sequence[Trial], episodes: Sequence[Episode], about: dict[str, str]
) -> pa.Table:
    rows = [
        {
            "policy": trial.column.policy,
            "weights": trial.column.weights,
            "level": trial.level,
            "instance": trial.index,
            "trial": trial.number,
            "outcome": episode.outcome,
            "succeeded": episode.succeeded,
            "num_actions": episode.num_actions,
            "actions": list(episode.actions),
            "states": list(episode.states.astype(np.float32)),
            "decision_seconds": list(episode.decision_seconds),
            "world_seconds": episode.world_seconds,
            "simulated_seconds": episode.simulated_seconds,
            "ending": episode.ending,
        }
        for trial, episode in zip(trials, episodes, strict=True)
    ]
    schema = _schema(episodes[0].states.shape[1], about)
    return pa.Table.from_pylist(rows, schema=schema)


def _from_table(table: pa.Table) -> Iterator[tuple[Trial, Episode]]:
    ends = np.cumsum(lengths(table["states"]))
    states_of_rows = np.split(numbers(table["states"]), ends[:-1])
    rows = table.drop_columns("states").to_pylist()
    for row, states in zip(rows, states_of_rows, strict=True):
        column = Column(row["policy"], row["weights"])
        yield (
            Trial(column, row["level"], row["instance"], row["trial"]),
            Episode(
                row["outcome"],
                row["actions"],
                states,
                row["decision_seconds"],
                row["world_seconds"],
                row["simulated_seconds"],
                row["ending"],
            ),
        )


def _read_table(path: Path) -> pa.Table:
    try:
        # Checksums are verified on the way.
        file = pq.ParquetFile(path, page_checksum_verification=True)
        if _METADATA_KEY not in (file.schema_arrow.metadata or {}):
            raise InputError(f"{path}: its metadata know of no results.")
        if lacking := {*_schema(1, {}).names} - {*file.schema_arrow.names}:
            raise InputError(f"{path}: lacks the column {min(lacking)!r}.")
        return file.read()
    except InputError:
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(
            f"{path}: not a readable file of results ({error}); without it, its "
            "episodes are run again."
        ) from error
