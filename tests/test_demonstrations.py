"""Demonstrations: their files, the folder that workers fill, and their replay."""

from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rhp_drake.errors import InputError
from rhp_drake.learning.dataset import load_dataset, without_oldest
from rhp_drake.learning.demonstration import Demonstration, training_task
from rhp_drake.learning.demonstration_files import about, lengths, read_table
from rhp_drake.learning.demonstration_folder import (
    demonstrate_tasks,
    describe,
)
from rhp_drake.learning.demonstrators import PlanningDemonstrator
from rhp_drake.learning.replay import compact, rebuild, verify
from rhp_drake.planning.search import SearchRecord
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.task import goals_reached

DEMONSTRATOR = PlanningDemonstrator(seed=11, num_objects=3)
NUM_TASKS = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations")
    assert list(demonstrate_tasks(path, range(NUM_TASKS), DEMONSTRATOR, 1, "abc")) == [
        *range(NUM_TASKS + 1)
    ]
    return path


@pytest.fixture(scope="module")
def data(folder):
    return load_dataset([folder])


def without_times(table):
    return table.drop_columns("seconds")


@dataclass(frozen=True)
class Counts:
    """A demonstrator that needs no time, and fails in some tasks."""

    seed: int = 3
    num_objects: int = 3
    fails_at: tuple[int, ...] = ()
    blocks_at: int | None = field(default=None, repr=False)

    def demonstrate(self, task):
        while task == self.blocks_at:
            time.sleep(0.01)
        if task in self.fails_at:
            raise PushModelError("the solver gave up")
        instance = training_task(self.seed, task, self.num_objects)
        return Demonstration(
            seed=self.seed,
            task=task,
            instance=instance,
            actions=np.arange(task % 5),
            states=np.repeat(instance.initial_state[None], task % 5 + 1, axis=0),
            search=SearchRecord(12).search(),
            seconds=0.25,
        )


def run(folder, num_tasks, demonstrator):
    """How many tasks are done after each step, of the first ones from 250 on."""
    return list(demonstrate_tasks(folder, range(250, 250 + num_tasks), demonstrator, 1))


def test_a_row_is_a_task(folder):
    table = pq.read_table(folder)
    assert table["task"].to_pylist() == [*range(NUM_TASKS)]
    assert set(table["seed"].to_pylist()) == {11}
    for row in table.to_pylist():
        instance = training_task(11, row["task"], 3)
        np.testing.assert_array_equal(row["initial_state"], instance.initial_state)
        np.testing.assert_array_equal(row["goals"], instance.goals.ravel())
        assert len(row["states"]) == len(row["actions"]) + 1
        assert row["num_transitions"] == len(row["search_actions"])
        assert row["num_transitions"] == len(row["search_next_states"])
        assert row["seconds"] > 0
        assert row["failure"] == ""
    assert describe(folder)["commit"] == "abc"
    assert "seed=11" in describe(folder)["demonstrator"]


def test_shards_fill_up_whatever_was_there(tmp_path):
    demonstrator = Counts()
    # Tasks 250 ... 299 are the rest of a shard, 300 ... 309 begin the next.
    assert run(tmp_path, 3, demonstrator) == [
        0,
        1,
        2,
        3,
    ]
    assert next(demonstrate_tasks(tmp_path, range(250, 310), demonstrator, 1)) == 3
    run(tmp_path, 60, demonstrator)
    assert [path.name for path in sorted(tmp_path.glob("*.parquet"))] == [
        "tasks_0000200.parquet",
        "tasks_0000300.parquet",
    ]
    assert run(tmp_path, 10, demonstrator) == [10]
    table = pq.read_table(tmp_path)
    assert table["task"].to_pylist() == [*range(250, 310)]
    assert lengths(table["actions"]).tolist() == [t % 5 for t in range(250, 310)]
    assert not list((tmp_path / "_single").iterdir())


def test_the_folder_is_the_same_whoever_fills_it(folder, tmp_path):
    list(demonstrate_tasks(tmp_path, range(3, 7), DEMONSTRATOR, 2))
    list(demonstrate_tasks(tmp_path, range(NUM_TASKS), DEMONSTRATOR, 2))
    name = "tasks_0000000.parquet"
    ours, theirs = (read_table(path / name) for path in (folder, tmp_path))
    assert without_times(ours).equals(without_times(theirs))


KILLED = """
from pathlib import Path
import signal
from rhp_drake.learning.demonstration_folder import demonstrate_tasks
from test_demonstrations import Counts
if __name__ == "__main__":
    # A shell's background jobs, and all they start, ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    counts = Counts(blocks_at=270)
    list(demonstrate_tasks(Path("FOLDER"), range(250, 450), counts, WORKERS))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("workers", [1, 2])
def test_work_stopped_at_any_moment_goes_on(tmp_path, number, workers):
    folder, script = tmp_path / "folder", tmp_path / "work.py"
    script.write_text(
        KILLED.replace("FOLDER", str(folder)).replace("WORKERS", str(workers))
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    worker = subprocess.Popen(
        [sys.executable, script],
        env=environment,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    while worker.poll() is None and len([*folder.rglob("task_*.parquet")]) < 20:
        time.sleep(0.01)
    with pytest.raises(InputError, match="another process works there"):
        next(demonstrate_tasks(folder, range(250, 450), Counts(), 1))
    worker.send_signal(number)
    worker.wait()
    # Its workers do not outlive it.
    while subprocess.run(["pgrep", "--session", str(worker.pid)]).returncode == 0:  # noqa: PLW1510
        time.sleep(0.01)

    steps = list(demonstrate_tasks(folder, range(250, 450), Counts(), 1))
    assert 20 <= steps[0] < 200
    assert steps[-1] == 200
    assert pq.read_table(folder)["task"].to_pylist() == [*range(250, 450)]


def test_death_between_writing_a_shard_and_removing_its_parts_doubles_nothing(tmp_path):
    run(tmp_path, 4, Counts())
    shard = read_table(tmp_path / "tasks_0000200.parquet")
    pq.write_table(shard.slice(1, 1), tmp_path / "_single/task_0000251.parquet")
    for path in (tmp_path / "_single", tmp_path):
        (path / ".tasks_0000200.parquet.12.tmp").write_bytes(b"half a file")
    assert pq.read_table(tmp_path)["task"].to_pylist() == [250, 251, 252, 253]
    assert run(tmp_path, 4, Counts()) == [4]
    assert pq.read_table(tmp_path)["task"].to_pylist() == [250, 251, 252, 253]


def test_a_damaged_single_is_done_again(tmp_path, caplog):
    run(tmp_path, 2, Counts())
    (tmp_path / "_single/task_0000252.parquet").write_bytes(b"half a task")
    assert run(tmp_path, 3, Counts()) == [2, 3]
    assert "The task is done again" in caplog.text


def test_commits_are_noted(tmp_path):
    for end, commit in ((252, "a"), (254, "b"), (256, "a")):
        list(demonstrate_tasks(tmp_path, range(250, end), Counts(), 1, commit))
    assert describe(tmp_path)["commit"] == "a, b"


def test_a_folder_is_one_demonstrator_s(folder):
    other = PlanningDemonstrator(seed=12, num_objects=3)
    with pytest.raises(InputError, match="seed=11"):
        next(demonstrate_tasks(folder, range(2), other, 1))


def test_a_failure_of_the_physics_costs_one_task(tmp_path, caplog):
    run(tmp_path, 10, Counts(fails_at=(257,)))
    assert "task 257 is left out: the solver gave up" in caplog.text
    row = pq.read_table(tmp_path).to_pylist()[7]
    assert row["failure"] == "the solver gave up"
    assert not row["solved"]
    assert row["actions"] == []
    # It is not tried again.
    assert list(
        demonstrate_tasks(tmp_path, range(250, 260), Counts(fails_at=(257,)), 1)
    ) == [10]


def test_bad_files_are_named(folder, tmp_path):
    with pytest.raises(InputError, match="holds no demonstrations"):
        load_dataset([tmp_path])
    with pytest.raises(InputError, match="no such file"):
        load_dataset([tmp_path / "nothing.parquet"])
    path = tmp_path / "tasks_0000000.parquet"
    path.write_bytes(b"not a table")
    with pytest.raises(InputError, match=r"tasks_0000000\.parquet: not a readable"):
        load_dataset([tmp_path])
    good = (folder / path.name).read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match=r"tasks_0000000\.parquet: not a readable"):
        load_dataset([path])
    pq.write_table(pq.read_table(folder).replace_schema_metadata(), path)
    with pytest.raises(InputError, match="its metadata know of no demonstrations"):
        load_dataset([path])


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("goals", np.nan, "a number of the column goals is not finite"),
        ("search_next_states", np.inf, "of the column search_next_states is not"),
        ("actions", 6, "the column actions has an unknown action"),
        ("search_actions", -1, "the column search_actions has an unknown action"),
    ],
)
def test_bad_numbers_are_named(column, value, message, folder, tmp_path):
    table = pq.read_table(folder)
    rows = table[column].to_pylist()
    if isinstance(rows[3][0], list):
        rows[3][0][0] = value
    else:
        rows[3][0] = value
    index = table.column_names.index(column)
    bad = pa.array(rows, table.schema.field(column).type)
    path = tmp_path / "bad.parquet"
    pq.write_table(table.set_column(index, table.schema.field(column), bad), path)
    with pytest.raises(InputError, match=rf"bad\.parquet: .*{message}"):
        load_dataset([path])


def test_other_tasks_describe_themselves_otherwise(folder, tmp_path):
    table = pq.read_table(folder)
    for name, part in (("first", table[:2]), ("second", table[2:4])):
        pq.write_table(part, tmp_path / name)
    first, second = (describe(tmp_path / name) for name in ("first", "second"))
    assert first["tasks"] == second["tasks"] == 2
    assert first != second
    assert describe(tmp_path / "first") == first


def test_a_flipped_bit_is_found(folder, tmp_path):
    content = bytearray((folder / "tasks_0000000.parquet").read_bytes())
    path = tmp_path / "tasks_0000000.parquet"
    for place in np.linspace(0.05, 0.9, 8):
        damaged = content.copy()
        damaged[int(place * len(content))] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="not a readable"):
            load_dataset([path])


def test_other_versions_are_refused(folder, tmp_path):
    table = pq.read_table(folder)
    details = about(table) | {"schema": 99}
    metadata = {b"rhp_drake": json.dumps(details).encode()}
    path = tmp_path / "tasks_0000000.parquet"
    pq.write_table(table.replace_schema_metadata(metadata), path)
    with pytest.raises(InputError, match="has version 99"):
        load_dataset([path])


def test_flat_arrays_agree_with_the_rows(folder, data):
    rows = pq.read_table(folder).to_pylist()
    for task, row in enumerate(rows):
        of_plan, of_search = data.plan_tasks == task, data.search_tasks == task
        np.testing.assert_array_equal(data.plan_states[of_plan], row["states"][:-1])
        np.testing.assert_array_equal(data.plan_actions[of_plan], row["actions"])
        length = len(row["actions"])
        np.testing.assert_array_equal(
            data.plan_actions_left[of_plan], np.arange(length, 0, -1)
        )
        np.testing.assert_array_equal(
            data.search_next_states[of_search], row["search_next_states"]
        )
    assert len(data.search_actions) == sum(row["num_transitions"] for row in rows)
    roots = data.search_origins < 0
    np.testing.assert_array_equal(
        data.search_states[~roots],
        data.search_next_states[data.search_origins[~roots]],
    )
    initial = np.array([row["initial_state"] for row in rows], np.float32)
    np.testing.assert_array_equal(
        data.search_states[roots], initial[data.search_tasks[roots]]
    )


def test_plans_end_at_the_goal(data):
    last = data.plan_actions_left == 1
    assert last.sum() == data.solved.sum()
    ends = PushModel(3).step(
        data.plan_states[last].astype(float), data.plan_actions[last].astype(int)
    )
    # Stored in single precision: an end on a region's border may be rounded out.
    reached = goals_reached(ends, data.goals[data.plan_tasks[last]])
    assert reached.mean() > 0.9


def test_folders_join(folder, data):
    both = load_dataset([folder, folder / "tasks_0000000.parquet"])
    assert len(both.goals) == 2 * len(data.goals)
    n = len(data.search_actions)
    second = both.search_origins[n:]
    np.testing.assert_array_equal(both.search_origins[:n], data.search_origins)
    np.testing.assert_array_equal(second < 0, data.search_origins < 0)
    linked = second >= 0
    np.testing.assert_array_equal(
        both.search_next_states[second[linked]], both.search_states[n:][linked]
    )


def test_seeds_and_actions_rebuild_the_states(folder, tmp_path):
    small, full = tmp_path / "compact.parquet", tmp_path / "full.parquet"
    solved = int(np.sum(pq.read_table(folder)["solved"].to_numpy()))
    assert compact([folder / "tasks_0000000.parquet"], small) == solved
    assert pq.read_table(small).column_names == ["seed", "task", "solved", "actions"]
    assert rebuild(small, full) == solved
    ours, rebuilt = load_dataset([folder]), load_dataset([full])
    np.testing.assert_array_equal(rebuilt.plan_states, ours.plan_states)
    np.testing.assert_array_equal(rebuilt.plan_actions, ours.plan_actions)
    # Each plan is one chain of transitions.
    np.testing.assert_array_equal(rebuilt.search_states, ours.plan_states)
    np.testing.assert_array_equal(rebuilt.search_actions, ours.plan_actions)
    linked = rebuilt.search_origins >= 0
    assert (~linked).sum() == solved
    np.testing.assert_array_equal(
        rebuilt.search_origins[linked], np.flatnonzero(linked) - 1
    )
    assert describe(full)["demonstrator"] == describe(folder)["demonstrator"]

    (replay,) = verify([folder / "tasks_0000000.parquet"], 1)
    assert replay.num_plans == replay.reached == replay.identical == solved
    (replay,) = verify([small], 1)
    assert replay.num_plans == replay.reached == solved
    assert replay.identical is None


def test_compact_files_do_for_replay_only(folder, tmp_path):
    small = tmp_path / "compact.parquet"
    compact([folder / "tasks_0000000.parquet"], small)
    with pytest.raises(InputError, match=r"lacks the column goals; .* rebuild"):
        load_dataset([small])
    list(demonstrate_tasks(tmp_path / "two", range(2), Counts(num_objects=2), 1))
    with pytest.raises(InputError, match="different numbers of objects"):
        compact([small, tmp_path / "two/tasks_0000000.parquet"], tmp_path / "mixed")
    pq.write_table(pq.read_table(small).slice(0, 0), small)
    with pytest.raises(InputError, match="holds no plans"):
        rebuild(small, tmp_path / "full.parquet")


def test_plans_that_miss_their_goals_are_not_rebuilt(folder, tmp_path, caplog):
    small, full = tmp_path / "compact.parquet", tmp_path / "full.parquet"
    solved = compact([folder / "tasks_0000000.parquet"], small)
    _turn_about(small, small)
    assert rebuild(small, full) == solved - 1
    assert "1 plans miss their goals and are left out" in caplog.text
    data = load_dataset([full])
    assert len(data.plan_actions) == len(data.plan_states)


def _turn_about(source, out):
    """Replaces the first plan by turns that move nothing."""
    table = pq.read_table(source)
    actions = table["actions"].to_pylist()
    actions[0] = [4] * len(actions[0])
    index = table.column_names.index("actions")
    column = table.schema.field("actions")
    plans = pa.array(actions, column.type)
    pq.write_table(table.set_column(index, column, plans), out)


def test_verification_notices_a_wrong_plan(folder, tmp_path):
    path = tmp_path / "tasks_0000000.parquet"
    _turn_about(folder, path)
    (replay,) = verify([path], 1)
    assert replay.reached == replay.identical == replay.num_plans - 1


def test_the_oldest_transitions_go_first(folder):
    data = load_dataset([folder])
    rest = without_oldest(data, 10)
    np.testing.assert_array_equal(rest.search_states, data.search_states[10:])
    np.testing.assert_array_equal(rest.plan_states, data.plan_states)
    linked = rest.search_origins >= 0
    np.testing.assert_array_equal(
        rest.search_next_states[rest.search_origins[linked]],
        rest.search_states[linked],
    )
    assert (data.search_origins[10:][~linked] < 10).all()
