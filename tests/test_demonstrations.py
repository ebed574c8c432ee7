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
import pyarrow.parquet as pq
import pytest
import torch

from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration import Demonstration, training_task
from rhp_drake.learning.demonstration_files import about, lengths, read_table
from rhp_drake.learning.demonstration_folder import (
    demonstrate_tasks,
    describe,
)
from rhp_drake.learning.demonstrations import load_demonstrations
from rhp_drake.learning.demonstrators import (
    GuidedDemonstrator,
    PlanningDemonstrator,
    RecedingHorizonDemonstrator,
)
from rhp_drake.learning.replay import compact, rebuild, verify
from rhp_drake.planning.search import SearchRecord
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.resources import models_path
from rhp_drake.task import goals_reached
from rhp_drake.value.q_network import QNetwork

DEMONSTRATOR = PlanningDemonstrator(seed=11, num_objects=3)
NUM_TASKS = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations")
    assert list(demonstrate_tasks(path, NUM_TASKS, DEMONSTRATOR, 1, "abc")) == [
        *range(NUM_TASKS + 1)
    ]
    return path


@pytest.fixture(scope="module")
def data(folder):
    return load_demonstrations([folder])


def without_times(table):
    return table.drop_columns("seconds")


@dataclass(frozen=True)
class Counts:
    """A demonstrator that needs no time, and fails in some tasks."""

    seed: int = 3
    num_objects: int = 3
    first_task: int = 250
    fails_at: tuple[int, ...] = ()
    seconds: float = field(default=0.0, repr=False)

    def demonstrate(self, task):
        time.sleep(self.seconds)
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
    assert list(demonstrate_tasks(tmp_path, 3, demonstrator, 1)) == [0, 1, 2, 3]
    assert next(iter(demonstrate_tasks(tmp_path, 60, demonstrator, 1))) == 3
    list(demonstrate_tasks(tmp_path, 60, demonstrator, 1))
    assert [path.name for path in sorted(tmp_path.glob("*.parquet"))] == [
        "tasks_0000200.parquet",
        "tasks_0000300.parquet",
    ]
    assert list(demonstrate_tasks(tmp_path, 10, demonstrator, 1)) == [10]
    table = pq.read_table(tmp_path)
    assert table["task"].to_pylist() == [*range(250, 310)]
    assert lengths(table["actions"]).tolist() == [t % 5 for t in range(250, 310)]
    assert not list((tmp_path / "_single").iterdir())


def test_the_folder_is_the_same_whoever_fills_it(folder, tmp_path):
    list(demonstrate_tasks(tmp_path, 5, DEMONSTRATOR, 2))
    list(demonstrate_tasks(tmp_path, NUM_TASKS, DEMONSTRATOR, 2))
    name = "tasks_0000000.parquet"
    ours, theirs = (read_table(path / name) for path in (folder, tmp_path))
    assert without_times(ours).equals(without_times(theirs))


def test_work_killed_at_any_moment_goes_on(tmp_path):
    code = (
        "from pathlib import Path; from test_demonstrations import Counts;"
        "from rhp_drake.learning.demonstration_folder import demonstrate_tasks;"
        f"path = Path({str(tmp_path)!r});"
        "list(demonstrate_tasks(path, 200, Counts(seconds=0.01), 1))"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}
    worker = subprocess.Popen([sys.executable, "-c", code], env=environment)
    while worker.poll() is None and len([*tmp_path.rglob("task*.parquet")]) < 20:
        time.sleep(0.01)
    assert worker.poll() is None
    worker.send_signal(signal.SIGKILL)
    worker.wait()
    done = {path.stem for path in tmp_path.rglob("task_*.parquet")}
    assert len(done) >= 15
    steps = list(demonstrate_tasks(tmp_path, 200, Counts(), 1))
    assert len(done) <= steps[0] < 200
    assert steps[-1] == 200
    assert pq.read_table(tmp_path)["task"].to_pylist() == [*range(250, 450)]


def test_death_between_writing_a_shard_and_removing_its_parts_doubles_nothing(tmp_path):
    list(demonstrate_tasks(tmp_path, 4, Counts(), 1))
    shard = read_table(tmp_path / "tasks_0000200.parquet")
    pq.write_table(shard.slice(1, 1), tmp_path / "_single/task_0000251.parquet")
    (tmp_path / "_single/task_0000254.parquet.12.tmp").write_bytes(b"half a task")
    assert list(demonstrate_tasks(tmp_path, 4, Counts(), 1)) == [4]
    assert pq.read_table(tmp_path)["task"].to_pylist() == [250, 251, 252, 253]


def test_a_folder_is_one_demonstrator_s(folder):
    other = PlanningDemonstrator(seed=12, num_objects=3)
    with pytest.raises(InputError, match="seed=11"):
        next(demonstrate_tasks(folder, NUM_TASKS, other, 1))


def test_a_failure_of_the_physics_costs_one_task(tmp_path, caplog):
    list(demonstrate_tasks(tmp_path, 10, Counts(fails_at=(257,)), 1))
    assert "task 257 is left out: the solver gave up" in caplog.text
    row = pq.read_table(tmp_path).to_pylist()[7]
    assert row["failure"] == "the solver gave up"
    assert not row["solved"]
    assert row["actions"] == []
    # It is not tried again.
    assert list(demonstrate_tasks(tmp_path, 10, Counts(fails_at=(257,)), 1)) == [10]


def test_bad_files_are_named(folder, tmp_path):
    with pytest.raises(InputError, match="holds no demonstrations"):
        load_demonstrations([tmp_path])
    with pytest.raises(InputError, match="no such file"):
        load_demonstrations([tmp_path / "nothing.parquet"])
    path = tmp_path / "tasks_0000000.parquet"
    path.write_bytes(b"not a table")
    with pytest.raises(InputError, match=r"tasks_0000000\.parquet: not a readable"):
        load_demonstrations([tmp_path])
    good = (folder / path.name).read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(InputError, match=r"tasks_0000000\.parquet: not a readable"):
        load_demonstrations([path])
    pq.write_table(pq.read_table(folder).replace_schema_metadata(), path)
    with pytest.raises(InputError, match="its metadata know of no demonstrations"):
        load_demonstrations([path])


def test_a_flipped_bit_is_found(folder, tmp_path):
    content = bytearray((folder / "tasks_0000000.parquet").read_bytes())
    path = tmp_path / "tasks_0000000.parquet"
    for place in np.linspace(0.05, 0.9, 8):
        damaged = content.copy()
        damaged[int(place * len(content))] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="not a readable"):
            load_demonstrations([path])


def test_other_versions_are_refused(folder, tmp_path):
    table = pq.read_table(folder)
    details = about(table) | {"schema": 99}
    metadata = {b"rhp_drake": json.dumps(details).encode()}
    path = tmp_path / "tasks_0000000.parquet"
    pq.write_table(table.replace_schema_metadata(metadata), path)
    with pytest.raises(InputError, match="has version 99"):
        load_demonstrations([path])


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
    both = load_demonstrations([folder, folder / "tasks_0000000.parquet"])
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
    ours, rebuilt = load_demonstrations([folder]), load_demonstrations([full])
    np.testing.assert_array_equal(rebuilt.plan_states, ours.plan_states)
    np.testing.assert_array_equal(rebuilt.plan_actions, ours.plan_actions)
    assert describe(full)["demonstrator"] == describe(folder)["demonstrator"]

    (replay,) = verify([folder / "tasks_0000000.parquet"], 1)
    assert replay.num_plans == replay.reached == replay.identical == solved
    (replay,) = verify([small], 1)
    assert replay.num_plans == replay.reached == solved
    assert replay.identical is None


def test_verification_notices_a_wrong_plan(folder, tmp_path):
    table = pq.read_table(folder)
    actions = table["actions"].to_pylist()
    actions[0] = [4] * len(actions[0])
    path = tmp_path / "tasks_0000000.parquet"
    index = table.column_names.index("actions")
    column = table.schema.field("actions")
    import pyarrow as pa

    pq.write_table(
        table.set_column(index, column, pa.array(actions, column.type)), path
    )
    (replay,) = verify([path], 1)
    assert replay.reached == replay.identical == replay.num_plans - 1


def equal(made, again):
    np.testing.assert_array_equal(made.actions, again.actions)
    np.testing.assert_array_equal(made.states, again.states)
    for name, array in vars(made.search).items():
        np.testing.assert_array_equal(array, getattr(again.search, name), err_msg=name)


def test_rhp_demonstrates_with_all_its_roll_outs(tmp_path):
    weights = tmp_path / "weights.safetensors"
    torch.manual_seed(0)
    QNetwork(3).save(weights)
    made, again = (
        RecedingHorizonDemonstrator(11, 3, weights).demonstrate(2) for _ in range(2)
    )
    equal(made, again)
    search = made.search
    pairs = np.column_stack([search.states, search.actions])
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    linked = search.origins >= 0
    assert linked.any()
    np.testing.assert_array_equal(
        search.next_states[search.origins[linked]], search.states[linked]
    )


def test_the_guided_search_demonstrates():
    weights = models_path() / "q_network/three_boxes.safetensors"
    made, again = (GuidedDemonstrator(11, 3, weights).demonstrate(2) for _ in range(2))
    equal(made, again)
    assert goals_reached(made.states[-1], made.instance.goals)
    assert len(made.actions) <= len(DEMONSTRATOR.demonstrate(2).actions)
