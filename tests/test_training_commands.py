"""`rhp imitate`, `rhp reinforce` and `rhp bench reinforcement`, also interrupted."""

import errno
import resource

import pyarrow.parquet as pq
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
import torch

from rhp_drake import cli
from rhp_drake.benchmarks import reinforcement as bench
from rhp_drake.benchmarks.reinforcement import Training, Trainings
from rhp_drake.commands import training as commands
from rhp_drake.commands.bench_reinforcement import _VARIANTS
from rhp_drake.errors import InputError
from rhp_drake.evaluation import validation
from rhp_drake.frozen_instances import load_instances
from rhp_drake.learning import training
from rhp_drake.learning.demonstration_files import write_table
from rhp_drake.learning.fitted_q import FittedQ, FittedQConfig
from rhp_drake.learning.imitation import Imitation
from rhp_drake.learning.learner import Learner
from rhp_drake.learning.reinforcement import Reinforcement, Rounds
from rhp_drake.learning.replay import SHIPPED_PLANS, rebuild
from rhp_drake.learning.variants import VARIANTS, Variant
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.q_network import ARCHITECTURES, SetQNetwork
from rhp_drake.value.weights import load_q_network, save_q_network

STEPS = 8


def rhp(monkeypatch, *arguments) -> int:
    """Runs the command line in this process, and returns its exit status."""
    monkeypatch.setattr("sys.argv", ["rhp", *map(str, arguments)])
    with pytest.raises(SystemExit) as info:
        cli.main()
    return info.value.code or 0


@pytest.fixture(scope="module")
def plans(tmp_path_factory):
    """Five plans with states."""
    folder = tmp_path_factory.mktemp("plans")
    write_table(folder / "few.parquet", pq.read_table(SHIPPED_PLANS).slice(0, 5))
    rebuild(folder / "few.parquet", folder / "plans.parquet")
    return folder / "plans.parquet"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A few validation tasks, and checkpoints, logs and validations every few steps."""
    monkeypatch.setattr(validation, "_NUM_TASKS", 2)
    monkeypatch.setattr(training, "_CHECKPOINT_PERIOD", 2)
    monkeypatch.setattr(commands, "_LOG_PERIOD", 2)
    monkeypatch.setattr(commands, "_VALIDATION_PERIOD", 4)


def imitate(monkeypatch, plans, out) -> int:
    options = ("--demonstrations", plans, "--out", out, "--steps", STEPS)
    return rhp(monkeypatch, "imitate", *options)


def curves(out) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard shows beside the weights: steps and values."""
    events = EventAccumulator(f"{out}.logs").Reload()
    return {
        name: [(event.step, event.value) for event in events.Scalars(name)]
        for name in events.Tags()["scalars"]
    }


def same_weights(one, other) -> bool:
    ours, theirs = (load_q_network(path, 3).state_dict() for path in (one, other))
    return all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_imitate_writes_weights_that_say_where_they_come_from(
    plans, monkeypatch, capsys, tmp_path
):
    out = tmp_path / "weights.safetensors"
    assert imitate(monkeypatch, plans, out) == 0
    assert "greedily solves" in capsys.readouterr().out
    provenance = load_q_network(out, 3).provenance
    assert provenance["command"].startswith("rhp imitate --demonstrations")
    assert provenance["num_steps"] == STEPS
    assert provenance["validation_successes_of_gp"].endswith(" of 2")
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"weights.safetensors", "weights.safetensors.logs"}


def interrupted(monkeypatch, at, error):
    """Makes the learner's next steps up to `at`, then raises the error, once."""
    whole_step = Learner.step

    def step(self):
        if self.num_steps == at:
            monkeypatch.setattr(Imitation, "step", whole_step)
            raise error
        whole_step(self)

    monkeypatch.setattr(Imitation, "step", step)


def test_ctrl_c_loses_nothing(plans, monkeypatch, capsys, tmp_path):
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    assert imitate(monkeypatch, plans, straight) == 0
    interrupted(monkeypatch, 5, KeyboardInterrupt())
    assert imitate(monkeypatch, plans, stopped) == 130
    assert "goes on from its last checkpoint" in capsys.readouterr().out
    assert not stopped.exists()
    assert imitate(monkeypatch, plans, stopped) == 0
    assert "Goes on from step 4" in capsys.readouterr().out
    assert same_weights(straight, stopped)
    shown = curves(straight)
    assert [step for step, _ in shown["loss"]] == [2, 4, 6, 8]
    assert [step for step, _ in shown["greedy success"]] == [4, 8]
    assert curves(stopped) == shown


def test_finished_work_is_not_done_again(plans, monkeypatch, capsys, tmp_path):
    out = tmp_path / "weights"
    assert imitate(monkeypatch, plans, out) == 0
    content, shown = out.read_bytes(), curves(out)
    assert imitate(monkeypatch, plans, out) == 0
    assert "weights: is there already." in " ".join(capsys.readouterr().out.split())
    options = ("--demonstrations", plans, "--out", out, "--steps", STEPS)
    assert rhp(monkeypatch, "imitate", *options, "--seed", 1) == 2
    assert "weights: holds weights of other work" in capsys.readouterr().err
    assert out.read_bytes() == content
    assert curves(out) == shown


def test_progress_is_measured_on_validation_tasks(monkeypatch):
    asked = []

    def load(name, num_objects):
        asked.append(name)
        return load_instances(name, num_objects)

    monkeypatch.setattr(validation, "load_instances", load)
    assert len(validation.greedy_successes(SetQNetwork(3))) == 2
    assert asked == [VALIDATION]


def test_a_bad_loss_stops_training_with_a_sentence(
    plans, monkeypatch, capsys, tmp_path
):
    out = tmp_path / "weights"
    whole_loss = Imitation._loss
    monkeypatch.setattr(
        Imitation,
        "_loss",
        lambda self: whole_loss(self) * (torch.nan if self.num_steps == 3 else 1),
    )
    assert imitate(monkeypatch, plans, out) == 1
    error = capsys.readouterr().err
    assert "rhp: the loss of step 3 is nan.  The last checkpoint is " in error
    assert not out.exists()
    assert (tmp_path / "weights.checkpoint").exists()


# TensorBoard writes from a thread of its own.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("limit", [100_000, 10], ids=["checkpoint", "logs"])
def test_a_full_disk_loses_nothing(limit, plans, monkeypatch, capsys, tmp_path):
    """A file that may not grow: to a program it is a full disk."""
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    assert imitate(monkeypatch, plans, straight) == 0
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        status = imitate(monkeypatch, plans, stopped)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert status == 1
    assert "cannot be written" in capsys.readouterr().err
    assert imitate(monkeypatch, plans, stopped) == 0
    assert same_weights(straight, stopped)


def test_reinforce_refuses_what_cannot_be(plans, monkeypatch, capsys, tmp_path):
    start = tmp_path / "start.safetensors"
    save_q_network(SetQNetwork(3), start)
    options = ("--demonstrations", plans, "--start", start, "--out", tmp_path / "w")
    assert rhp(monkeypatch, "reinforce", *options, "--variant", "paper") == 2
    assert "the variant paper has the network 'paper'." in capsys.readouterr().err
    assert rhp(monkeypatch, "reinforce", *options, "--variant", "worst") == 2
    assert "'worst' is neither best nor paper." in capsys.readouterr().err
    assert rhp(monkeypatch, "reinforce", *options, "--steps", "1500") == 2
    assert "1500 steps are no whole number of rounds" in capsys.readouterr().err


@pytest.mark.parametrize("variant", ["best", "paper"])
def test_reinforce_ends_the_same_if_it_is_stopped(
    variant, tiny_variants, plans, monkeypatch, capsys, tmp_path
):
    torch.manual_seed(0)
    start = tmp_path / "start.safetensors"
    save_q_network(ARCHITECTURES[VARIANTS[variant].network](3), start)

    def reinforce(out) -> int:
        options = ("--demonstrations", plans, "--start", start, "--variant", variant)
        more = ("--steps", STEPS, "--workers", 1, "--out", out)
        return rhp(monkeypatch, "reinforce", *options, *more)

    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    assert reinforce(straight) == 0
    # While it learns, and while it acts.
    step, act = FittedQ.step, Reinforcement._act

    def stopping_step(self):
        if self.num_steps == 3:
            raise KeyboardInterrupt
        step(self)

    def stopping_act(self, index):
        for done in act(self, index):
            yield done
            if (index, done) == (1, 1):
                raise KeyboardInterrupt

    monkeypatch.setattr(FittedQ, "step", stopping_step)
    assert reinforce(stopped) == 130
    monkeypatch.setattr(FittedQ, "step", step)
    monkeypatch.setattr(Reinforcement, "_act", stopping_act)
    assert reinforce(stopped) == 130
    monkeypatch.setattr(Reinforcement, "_act", act)
    assert reinforce(stopped) == 0
    assert same_weights(straight, stopped)
    provenance = load_q_network(stopped, 3).provenance
    assert provenance["command"].startswith("rhp reinforce --demonstrations")
    assert provenance["rounds"]["num_tasks"] == 2
    assert not list(tmp_path.glob("*.rounds")) + list(tmp_path.glob("*.checkpoint"))


def test_all_variants_are_trained_by_default():
    assert _VARIANTS.split(",") == list(VARIANTS)


@pytest.fixture
def tiny_variants(plans, monkeypatch):
    """All variants, with rounds of two tasks and four steps; few plans."""
    for name, variant in VARIANTS.items():
        rounds = {**vars(variant.rounds), "num_tasks": 2, "num_steps": 4}
        learning = {**vars(variant.learning), "batch_size": 16}
        monkeypatch.setitem(
            VARIANTS,
            name,
            Variant(
                learning=FittedQConfig(**learning),
                rounds=Rounds(**rounds),
                from_scratch=variant.from_scratch,
                plans_only=variant.plans_only,
                network=variant.network,
            ),
        )
    monkeypatch.setattr(bench, "_NUM_DEMONSTRATIONS", 3)
    monkeypatch.setattr(bench, "_PERIOD", 4)
    monkeypatch.setattr(bench, "_NUM_TASKS", 2)


def test_variants_side_by_side(tiny_variants, monkeypatch, tmp_path):
    names = ("best", "paper", "from_scratch")
    wanted = [Training(name, 0) for name in names]
    straight = Trainings(tmp_path / "straight", STEPS, "commit")
    results = list(straight.make(wanted, 1))
    assert [result.training for result in results] == wanted
    for result in results:
        assert [step for step, _ in result.curve] == [4, 8]
        assert result.num_transitions > 0
    # Roll-outs and searches count, beside what was executed.
    assert results[0].num_transitions > 3 * results[1].num_transitions

    # Again, stopped before the first is written.
    folder = Trainings(tmp_path / "stopped", STEPS, "commit")
    for name, fails_at in (("greedy_successes", 2), ("_rhp33_successes", 1)):
        evaluate, calls = getattr(bench, name), iter(range(1, 99))

        def fail(network, evaluate=evaluate, calls=calls, fails_at=fails_at):
            if next(calls) == fails_at:
                raise OSError(errno.ENOSPC, "No space left on device")
            return evaluate(network)

        monkeypatch.setattr(bench, name, fail)
        with pytest.raises(OSError, match="No space"):
            list(folder.make(wanted, 1))
        monkeypatch.setattr(bench, name, evaluate)
    assert list(folder.make(wanted, 1)) == results
    assert list(folder.make(wanted, 1)) == results
    with pytest.raises(InputError, match="made with other settings"):
        list(Trainings(tmp_path / "straight", STEPS + 4, "commit").make(wanted, 1))
