"""The baseline of `rhp bench dqn`: it trains, it repeats itself."""

import json

import numpy as np
import pytest
import torch

from rhp_drake import cli
from rhp_drake.benchmarks import dqn
from rhp_drake.frozen_instances import load_instances
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.weights import load_q_network


@pytest.fixture
def few(monkeypatch):
    """Two tasks an evaluation, one every 12 steps."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr(dqn, "NUM_INSTANCES", 2)
    monkeypatch.setattr(dqn, "EVALUATION_PERIOD", 12)


def rhp(monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["rhp", *arguments])
    with pytest.raises(SystemExit) as info:
        cli.main()
    return info.value.code or 0


def train(steps, seed):
    seen, curve = [], []
    network = dqn.train_dqn(steps, seed, seen.append, curve.append)
    return network, seen, curve


def test_training_looks_at_the_policy_now_and_then(few):
    _, seen, curve = train(32, seed=0)
    assert seen == [*range(1, 33)]
    assert [evaluation.steps for evaluation in curve] == [12, 24, 32]
    assert all(evaluation.trials == 2 for evaluation in curve)
    seconds = [evaluation.seconds for evaluation in curve]
    assert 0 < seconds[0] < seconds[1] < seconds[2]


def test_the_same_seed_learns_the_same(few):
    first, again, other = (train(16, seed)[0] for seed in (1, 1, 2))
    assert repr(first) == repr(again) != repr(other)


def test_the_network_is_the_one_that_was_trained(few):
    model = dqn.make_dqn(seed=0)
    network = dqn.to_q_network(model)
    instance = load_instances(VALIDATION)[0]
    observation, _ = model.get_env().envs[0].reset(options={"instance": instance})
    with torch.no_grad():
        expected = model.q_net(torch.tensor(observation[None]))
    values = network.values(instance.initial_state[None], instance.goals)
    np.testing.assert_allclose(values, expected, rtol=1e-6)


def test_going_on_for_ever_is_worth_what_failure_is():
    assert -1 / (1 - dqn.SETTINGS["gamma"]) == pytest.approx(-40)


def test_command(few, monkeypatch, capsys, tmp_path):
    options = ["--steps", "16", "--seed", "3", "--out", str(tmp_path / "new")]
    assert rhp(monkeypatch, "bench", "dqn", *options) == 0
    printed = capsys.readouterr().out
    assert "% of 2 tasks" in printed
    assert "stable_baselines3" in printed
    record = json.loads((tmp_path / "new" / "seed_3.json").read_text())
    assert record["seed"] == 3
    assert record["gamma"] == dqn.SETTINGS["gamma"]
    assert [entry["steps"] for entry in record["curve"]] == [12, 16]
    network = load_q_network(tmp_path / "new" / "seed_3.safetensors", 3)
    assert network.provenance["command"] == " ".join(["rhp", "bench", "dqn", *options])


def test_command_without_stable_baselines(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(dqn, "find_spec", lambda _: None)
    assert rhp(monkeypatch, "bench", "dqn", "--out", str(tmp_path)) == 2
    assert capsys.readouterr().err.startswith("rhp: this needs Stable-Baselines3: pip")
