"""Demonstrations as Parquet files, a row a task.

| column | type | what |
| --- | --- | --- |
| `seed`, `task` | int64 | name the instance: `demonstration.training_task` |
| `initial_state` | double[3 + 3 m] | s_init: x, y (m), heading (rad) of each body |
| `goals` | double[2 m] | centres of the goal regions, m |
| `solved` | bool | whether there is a plan |
| `actions` | list of int8 | the plan, `task.Action`; empty if not solved |
| `states` | list of float[3 + 3 m] | s_0 ... s_L |
| `num_transitions` | int32 | T, actions simulated |
| `seconds` | double | computation, on the machine that did it |
| `failure` | string | why the task was left out; empty otherwise |
| `search_actions` | list of int8 | the T actions simulated |
| `search_origins` | list of int32 | which of them led to its state; -1: s_init |
| `search_next_states` | list of float[3 + 3 m] | the T states they led to |

All but `seconds` depend on the demonstrator and the task alone.  A folder of them is
one table: ``pyarrow.parquet.read_table(folder)``, or ``pandas.read_parquet(folder)``.
The schema's metadata has the key "rhp_drake": JSON with the schema's version, m, the
demonstrator and the commit of the code (several, if it changed meanwhile).  Pages carry
checksums.

A compact file has the columns `seed`, `task`, `solved` and `actions` only.
"""

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.learning.demonstration import Demonstration

SCHEMA_VERSION: Final = 2
# All that `replay` needs.
COMPACT_COLUMNS: Final = ("seed", "task", "solved", "actions")
METADATA_KEY: Final = b"rhp_drake"
_ACTIONS: Final = pa.list_(pa.int8())


def _schema(num_objects: int, about: dict[str, Any]) -> pa.Schema:
    size = 3 + 3 * num_objects
    states = pa.list_(pa.list_(pa.float32(), size))
    metadata = {"schema": SCHEMA_VERSION, "num_objects": num_objects, **about}
    return pa.schema(
        {
            "seed": pa.int64(),
            "task": pa.int64(),
            "initial_state": pa.list_(pa.float64(), size),
            "goals": pa.list_(pa.float64(), 2 * num_objects),
            "solved": pa.bool_(),
            "actions": _ACTIONS,
            "states": states,
            "num_transitions": pa.int32(),
            "seconds": pa.float64(),
            "failure": pa.string(),
            "search_actions": _ACTIONS,
            "search_origins": pa.list_(pa.int32()),
            "search_next_states": states,
        },
        metadata={METADATA_KEY: json.dumps(metadata).encode()},
    )


def to_table(
    demonstrations: Sequence[Demonstration], about: dict[str, str]
) -> pa.Table:
    """Demonstrations of one m as a table.

    Args:
        demonstrations: At least one.
        about: Who made them, for the metadata.
    """
    schema = _schema(demonstrations[0].instance.num_objects, about)
    d = demonstrations
    no_actions = np.empty(0, np.int8)
    columns = {
        "seed": [x.seed for x in d],
        "task": [x.task for x in d],
        "initial_state": _fixed_lists([x.instance.initial_state for x in d]),
        "goals": _fixed_lists([x.instance.goals.ravel() for x in d]),
        "solved": [x.actions is not None for x in d],
        "actions": _lists(
            [no_actions if x.actions is None else x.actions for x in d], np.int8
        ),
        "states": _lists([x.states for x in d], np.float32),
        "num_transitions": [len(x.search.actions) for x in d],
        "seconds": [x.seconds for x in d],
        "failure": [x.failure for x in d],
        "search_actions": _lists([x.search.actions for x in d], np.int8),
        "search_origins": _lists([x.search.origins for x in d], np.int32),
        "search_next_states": _lists([x.search.next_states for x in d], np.float32),
    }
    return pa.Table.from_arrays(
        [
            column
            if isinstance(column, pa.Array)
            else pa.array(column, schema.field(name).type)
            for name, column in columns.items()
        ],
        schema=schema,
    )


def _lists(arrays: list[np.ndarray], dtype: type) -> pa.Array:
    """A column of lists: of numbers, or of rows of numbers."""
    offsets = np.cumsum([0, *map(len, arrays)], dtype=np.int32)
    values: np.ndarray = np.concatenate(arrays).astype(dtype)
    flat = pa.array(values) if values.ndim == 1 else _fixed_lists(values)
    return pa.ListArray.from_arrays(pa.array(offsets), flat)


def _fixed_lists(rows: Any) -> pa.Array:
    """A column of rows of numbers, all of the same length."""
    rows = np.asarray(rows)
    return pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel()), rows.shape[1])


def write_table(path: Path, table: pa.Table) -> None:
    """Writes a table, whole or not at all."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    write_atomically(path, sink.getvalue().to_pybytes())


def read_table(path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Reads a file of demonstrations, or some of its columns.

    Raises:
        InputError: If it is damaged, something else, or lacks a column; the message
            names it.
    """
    try:
        # Checksums are verified on the way.
        file = pq.ParquetFile(path, page_checksum_verification=True)
        metadata = (file.schema_arrow.metadata or {}).get(METADATA_KEY)
        if metadata is None:
            raise InputError(f"{path}: its metadata know of no demonstrations.")
        schema = json.loads(metadata)["schema"]
        if schema != SCHEMA_VERSION:
            raise InputError(
                f"{path}: has version {schema} of the schema of demonstrations; this "
                f"code reads {SCHEMA_VERSION}."
            )
        lacking = set(columns or ()) - set(file.schema_arrow.names)
        if lacking:
            raise InputError(
                f"{path}: lacks the column {min(lacking)}; if it is compact, "
                "`rhp demos rebuild` restores the states."
            )
        return file.read(columns)
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file.") from None
    except InputError:
        raise
    except (OSError, ValueError, TypeError, KeyError, pa.ArrowException) as error:
        raise InputError(
            f"{path}: not a readable file of demonstrations ({error})."
        ) from error


def about(table: pa.Table) -> dict[str, Any]:
    """What the metadata says: "schema", "num_objects", "demonstrator", "commit"."""
    return json.loads(table.schema.metadata[METADATA_KEY])


def join_tables(tables: Sequence[pa.Table]) -> pa.Table:
    """One table, its rows in the order of their tasks; of a task twice, the last.

    Its metadata name all demonstrators and commits of the tables.

    Raises:
        InputError: If the tables are of different numbers of objects.
    """
    details = [about(table) for table in tables]
    if len({d["num_objects"] for d in details}) > 1:
        raise InputError("the demonstrations are of different numbers of objects.")
    rows = {
        (seed, task): table.slice(row, 1)
        for table in tables
        for row, (seed, task) in enumerate(
            zip(table["seed"].to_pylist(), table["task"].to_pylist(), strict=True)
        )
    }
    joined = pa.concat_tables([rows[key] for key in sorted(rows)]).combine_chunks()
    commits = [commit for d in details for commit in d["commit"].split(", ")]
    metadata = details[0] | {
        "demonstrator": " and ".join(dict.fromkeys(d["demonstrator"] for d in details)),
        "commit": ", ".join(dict.fromkeys(commits)),
    }
    return joined.replace_schema_metadata({METADATA_KEY: json.dumps(metadata).encode()})


def numbers(column: pa.ChunkedArray) -> np.ndarray:
    """All numbers of a column of lists, one after the other.

    Returns:
        Shape (N,), or (N, k) for lists of rows of k numbers.
    """
    values: Any = column.combine_chunks()
    while isinstance(values, pa.ListArray):
        values = values.flatten()
    if isinstance(values, pa.FixedSizeListArray):
        size = values.type.list_size
        return values.flatten().to_numpy(zero_copy_only=False).reshape(-1, size)
    return values.to_numpy(zero_copy_only=False)


def lengths(column: pa.ChunkedArray) -> np.ndarray:
    """How long each list of a column is, shape (rows,)."""
    return column.combine_chunks().value_lengths().to_numpy(zero_copy_only=False)
