"""`rhp figure4`: batches of tasks, interrupted work, the table, the picture."""

import csv

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rhp_drake import cli
from rhp_drake.evaluation import figure4
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.figure4_data import (
    Point,
    PointResult,
    batch_successes,
    curve,
    read_results,
    write_results,
)
from rhp_drake.evaluation.plots import draw_figure4
from rhp_drake.evaluation.statistics import t_interval, wilson_interval
from rhp_drake.frozen_instances import load_instances
from rhp_drake.learning import training
from rhp_drake.learning.dataset import first_plans, load_dataset
from rhp_drake.learning.demonstration_files import write_table
from rhp_drake.learning.demonstration_folder import demonstrate_tasks
from rhp_drake.learning.demonstrators import PlanningDemonstrator
from rhp_drake.learning.imitation import Imitation
from rhp_drake.learning.replay import SHIPPED_PLANS
from rhp_drake.value.weights import load_q_network

NUM_PLANS = 5


def rhp(monkeypatch, *arguments) -> int:
    """Runs the command line in this process, and returns its exit status."""
    monkeypatch.setattr("sys.argv", ["rhp", *arguments])
    with pytest.raises(SystemExit) as info:
        cli.main()
    return info.value.code or 0


@pytest.fixture
def few(monkeypatch, tmp_path):
    """Five plans come with the package, a batch is one task, checkpoints are near."""
    plans = tmp_path / "few_plans.parquet"
    write_table(plans, pq.read_table(SHIPPED_PLANS).slice(0, NUM_PLANS))
    monkeypatch.setattr(figure4, "SHIPPED_PLANS", plans)
    monkeypatch.setattr(
        figure4, "load_instances", lambda name: load_instances(name)[:25]
    )
    monkeypatch.setattr(training, "_CHECKPOINT_PERIOD", 3)


def results_by_hand():
    """Two trainings on 100 plans, one on 300, in no order."""
    first = [20, 10] + [0] * 23
    second = [10, 10] + [0] * 23
    return [
        PointResult(Point(300, 0), (15,) * 25, 20),
        PointResult(Point(100, 1), tuple(second), 20),
        PointResult(Point(100, 0), tuple(first), 20),
    ]


def test_batches_are_tasks_in_a_row():
    succeeded = np.zeros(500, bool)
    succeeded[:20] = succeeded[45:48] = succeeded[499] = True
    assert batch_successes(succeeded) == (20, 0, 3, *[0] * 21, 1)


def test_curve_by_hand():
    few_plans, many_plans = curve(results_by_hand())
    assert few_plans.num_plans == 100
    assert few_plans.seed_rates == pytest.approx((30 / 500, 20 / 500))
    assert few_plans.success == pytest.approx(0.05)
    # The batches' means over both trainings.
    expected = t_interval([0.75, 0.5] + [0] * 23)
    assert (few_plans.low, few_plans.high) == pytest.approx(expected)
    assert many_plans.num_plans == 300
    assert (many_plans.low, many_plans.high) == pytest.approx((0.75, 0.75))


def test_table_by_hand(tmp_path):
    path = tmp_path / "figure4.csv"
    write_results(path, results_by_hand())
    assert read_results(path) == results_by_hand()[::-1]
    with path.open() as file:
        row = next(csv.DictReader(file))
    assert (row["plans"], row["seed"], row["success"]) == ("100", "0", "0.0600")
    expected = (*t_interval([1, 0.5] + [0] * 23), *wilson_interval(30, 500))
    names = ("t_low", "t_high", "wilson_low", "wilson_high")
    assert [float(row[name]) for name in names] == pytest.approx(expected, abs=5e-5)
    assert (row["batch_size"], row["batch_1"], row["batch_25"]) == ("20", "20", "0")


def test_picture_shows_the_points():
    (axes,) = draw_figure4(curve(results_by_hand())).axes
    lines = {line.get_label(): line for line in axes.lines}
    mean = lines["mean over trainings"].get_xydata()
    np.testing.assert_allclose(mean, [[100, 5], [300, 75]])
    single = lines["one training"].get_xydata()
    np.testing.assert_allclose(single, [[100, 6], [100, 4], [300, 75]])
    (note,) = axes.texts
    assert "48 % with 9000 plans" in note.get_text()


def test_first_plans(tmp_path):
    demonstrator = PlanningDemonstrator(seed=11, num_objects=3)
    list(demonstrate_tasks(tmp_path, range(4), demonstrator, 1))
    data = load_dataset([tmp_path])
    two = first_plans(data, 2)
    assert two.solved.tolist() == [True, True, False, False]
    kept = data.plan_tasks < 2
    np.testing.assert_array_equal(two.plan_states, data.plan_states[kept])
    np.testing.assert_array_equal(two.plan_actions_left, data.plan_actions_left[kept])
    # A task without a plan does not count.
    data.solved[1] = False
    assert set(first_plans(data, 2).plan_tasks) == {0, 2}


def arguments(out, *more):
    return ("figure4", "--out", str(out), "--steps", "8", "--workers", "1", *more)


def contents(folder):
    """What a folder holds in the end, but for the picture of pixels."""
    files = {path.name: path for path in folder.rglob("*") if path.is_file()}
    networks = {
        name: load_q_network(files.pop(name), 3)
        for name in [*files]
        if name.endswith(".safetensors")
    }
    return {
        name: path.read_bytes() for name, path in files.items() if path.suffix != ".png"
    } | {name: (repr(q), q.provenance) for name, q in networks.items()}


def all_succeed(monkeypatch):
    """Episodes are not run."""
    monkeypatch.setattr(
        figure4,
        "greedy_episodes",
        lambda network, instances: [
            Episode("succeeded", [0], np.empty((2, 12))) for _ in instances
        ],
    )


def test_interrupted_work_ends_the_same(few, monkeypatch, capsys, tmp_path):
    sizes = ("--plans", "5,2")
    assert rhp(monkeypatch, *arguments(tmp_path / "straight", *sizes)) == 0
    printed = capsys.readouterr().out
    assert "2 plans, seed 0: " in printed
    assert "95 %, t over 25 batches" in printed
    assert (tmp_path / "straight/figure4.png").read_bytes().startswith(b"\x89PNG")

    step, steps = Imitation.step, []

    def stop_in_the_second_training(self):
        if len(steps) == 8 + 5:
            raise KeyboardInterrupt
        steps.append(self.num_steps)
        step(self)

    monkeypatch.setattr(Imitation, "step", stop_in_the_second_training)
    stopped = tmp_path / "stopped"
    assert rhp(monkeypatch, *arguments(stopped, *sizes)) == 130
    assert not (stopped / "figure4.csv").exists()
    steps.clear()
    assert rhp(monkeypatch, *arguments(stopped, *sizes)) == 0
    # On from the checkpoint of the second training; the first one is done.
    assert steps == [3, 4, 5, 6, 7]
    assert contents(stopped) == contents(tmp_path / "straight")

    steps.clear()
    assert rhp(monkeypatch, *arguments(stopped, *sizes)) == 0
    assert steps == []
    assert contents(stopped) == contents(tmp_path / "straight")

    # More points may be added, but none of other settings.
    all_succeed(monkeypatch)
    assert rhp(monkeypatch, *arguments(stopped, "--plans", "2,3")) == 0
    plans = [result.point.num_plans for result in read_results(stopped / "figure4.csv")]
    assert plans == [2, 3]
    assert rhp(monkeypatch, *arguments(stopped, *sizes, "--steps", "9")) == 2
    assert "was made with other settings (num_steps);" in capsys.readouterr().err
    (stopped / "settings.json").write_text("[1]")
    assert rhp(monkeypatch, *arguments(stopped, *sizes)) == 2
    assert "settings.json: not readable settings (" in capsys.readouterr().err


def test_weights_say_where_they_come_from(few, monkeypatch, tmp_path):
    all_succeed(monkeypatch)
    more = ("--plans", "3", "--seeds", "2", "--instances", "validation")
    assert rhp(monkeypatch, *arguments(tmp_path / "out", *more)) == 0
    networks = [
        load_q_network(tmp_path / f"out/points/plans_00003_seed_{seed}.safetensors", 3)
        for seed in range(2)
    ]
    assert repr(networks[0]) != repr(networks[1])
    for seed, network in enumerate(networks):
        known = network.provenance
        assert (known["num_plans"], known["seed"]) == (3, seed)
        assert (known["num_steps"], known["instances"]) == (8, "validation")
        assert known["successes"] == [1] * 25


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("--plans 100,9000", "9000 plans were asked for; there are 8895."),
        ("--plans 100,,300", "--plans: '100,,300' is no list of numbers above 0,"),
        ("--plans 0", "--plans: '0' is no list of numbers above 0,"),
        ("--instances training", "'training' is not a set of instances: "),
        ("--demonstrations nothing", "nothing: there is no such file."),
    ],
)
def test_bad_input(more, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert rhp(monkeypatch, *arguments("out", *more.split())) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"rhp: {message}")
    # Before any work, and nothing is left behind.
    assert not list(tmp_path.iterdir())


def test_plans_that_miss_their_goals_do_not_count(few, monkeypatch, capsys, tmp_path):
    plans = figure4.SHIPPED_PLANS
    table = pq.read_table(plans)
    actions = [
        row[:1] if k == 2 else row for k, row in enumerate(table["actions"].to_pylist())
    ]
    field = table.schema.field("actions")
    broken = table.set_column(
        table.column_names.index("actions"), field, pa.array(actions, field.type)
    )
    write_table(plans, broken)
    all_succeed(monkeypatch)
    more = ("--plans", str(NUM_PLANS))
    assert rhp(monkeypatch, *arguments(tmp_path / "out", *more)) == 2
    assert "rhp: 5 plans were asked for; there are 4." in capsys.readouterr().err
    assert rhp(monkeypatch, *arguments(tmp_path / "out", "--plans", "4")) == 0


def test_demonstrations_of_ones_own(few, monkeypatch, capsys, tmp_path):
    all_succeed(monkeypatch)
    own = tmp_path / "own"
    for folder, num_objects in ((own, 3), (tmp_path / "two", 2)):
        demonstrator = PlanningDemonstrator(seed=11, num_objects=num_objects)
        list(demonstrate_tasks(folder, range(2), demonstrator, 1))
    more = ("--demonstrations", str(own), "--plans")
    assert rhp(monkeypatch, *arguments(tmp_path / "out", *more, "9")) == 2
    assert "rhp: 9 plans were asked for; there are 2." in capsys.readouterr().err
    assert rhp(monkeypatch, *arguments(tmp_path / "out", *more, "2")) == 0
    assert not (tmp_path / "out/plans.parquet").exists()
    more = ("--demonstrations", str(tmp_path / "two"), "--plans", "2")
    assert rhp(monkeypatch, *arguments(tmp_path / "out2", *more)) == 2
    assert "are of 2 objects, the tasks to evaluate on of 3" in capsys.readouterr().err
