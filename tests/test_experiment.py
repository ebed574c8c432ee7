"""Experiments: what is run, and that it depends on nothing but its names."""

from dataclasses import replace

import numpy as np
import pytest
from small_experiment import experiment

from rhp_drake.errors import InputError
from rhp_drake.evaluation.experiment import (
    Batch,
    Column,
    drawn_physics,
    make_columns,
    run_batch,
    run_batches,
)
from rhp_drake.frozen_instances import load_instances
from rhp_drake.random_streams import VALIDATION
from rhp_drake.resources import models_path
from rhp_drake.task import MAX_ACTIONS, allowed_actions
from rhp_drake.value.q_network import SetQNetwork
from rhp_drake.value.weights import save_q_network

GP = Column("gp", "best")


def same(one, other) -> bool:
    return (
        one.outcome == other.outcome
        and list(one.actions) == list(other.actions)
        and np.array_equal(one.states, other.states)
    )


def test_columns_are_policies_with_each_of_the_weights():
    columns = make_columns(["kdp", "gp", "rhp33"], ["imitation", "best"])
    assert [str(column) for column in columns] == [
        *("kdp", "gp imitation", "rhp33 imitation"),
        *("gp best", "rhp33 best"),
    ]
    assert columns[GP].q_network == "package://rhp_drake/q_network/best.safetensors"
    path = str(models_path() / "q_network/paper.safetensors")
    (column,) = make_columns(["gp"], [path])
    assert column == Column("gp", "paper")


def test_the_temperature_is_of_policies_that_have_one():
    columns = make_columns(["gp", "rhp33"], ["best"], temperature=2.0)
    assert columns[Column("rhp33", "best")].temperature == 2.0
    with pytest.raises(InputError, match="temperature is -1"):
        make_columns(["rhp33"], ["best"], temperature=-1.0)


@pytest.mark.parametrize(
    ("policies", "weights", "message"),
    [
        (["dance"], ["best"], "dance"),
        (["gp"], ["nothing"], "nothing: there is no such file of weights"),
        (["gp"], ["best", str(models_path() / "q_network/best.safetensors")], "same n"),
    ],
)
def test_bad_columns(policies, weights, message):
    with pytest.raises(InputError, match=message):
        make_columns(policies, weights)


def test_batches_are_whole_trials_one_after_the_other():
    batches = experiment(num_instances=30, num_trials=2, levels=["none", "high"])
    made = [
        (batch.number, batch.level, [*batch.indices]) for batch in batches.batches()
    ]
    first, rest = [*range(20)], [*range(20, 30)]
    assert made == [
        (number, level, indices)
        for number in (0, 1)
        for level in ("none", "high")
        for indices in (first, rest)
    ]


def test_an_episode_depends_on_its_names_alone():
    """Not on what is run beside it, nor on the number of workers."""
    wide = experiment(["random", "gp"], num_trials=2, levels=["none", "high"])
    alone = experiment()
    batches = wide.batches()
    (batch,) = alone.batches()
    results = dict(run_batches(wide, batches, 2))
    assert len(results) == len(batches)
    for one, other in zip(run_batch(batch, alone), results[batch], strict=True):
        assert same(one, other)
    again = replace(batch, number=1)
    assert not all(map(same, results[batch], results[again]))


def test_trials_differ_in_their_physics_and_policies_do_not():
    instance = load_instances(VALIDATION)[0]
    others = Column("rhp66", "best")
    keys = {
        drawn_physics(batch.trials()[0], instance, 0).key()
        for number in range(3)
        for column in (GP, others)
        for batch in [Batch(column, "high", number, range(1))]
    }
    assert len(keys) == 3


def test_episodes_tell_what_happened():
    (batch,) = experiment(num_instances=3).batches()
    for episode in run_batch(batch, experiment(num_instances=3)):
        assert len(episode.states) == len(episode.actions) + 1 <= MAX_ACTIONS + 1
        for state, action in zip(episode.states[:-1], episode.actions, strict=True):
            assert allowed_actions(state)[action]
        assert len(episode.decision_seconds) == len(episode.actions)
        assert episode.seconds > episode.world_seconds > 0


def test_numbers_of_objects_in_turn(tmp_path):
    """Also in one process, which keeps what it made."""
    weights = tmp_path / "weights.safetensors"
    save_q_network(SetQNetwork(3), weights)
    for num_objects in (1, 3, 5):
        work = experiment(
            weights=[str(weights)], num_objects=num_objects, num_instances=1
        )
        (batch,) = work.batches()
        (episode,) = run_batch(batch, work)
        assert episode.states.shape[1] == 3 + 3 * num_objects
        assert episode.outcome in ("succeeded", "out of actions", "object fell")


def test_weights_for_other_objects_are_found_before_the_work_begins():
    with pytest.raises(InputError, match="the weights are for 3 objects, not 5"):
        experiment(["kdp", "gp"], ["imitation"], num_objects=5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"levels": ["hihg"]}, "'hihg' is not a level of uncertainty: none, low,"),
        ({"num_objects": 5, "world": "station"}, "the station has 3 objects, not 5"),
        ({"world": "moon"}, "'moon' is not a world: planar, station, or package"),
        ({"world": "moon:make"}, "the world moon:make: cannot be imported"),
        ({"world": ".math:make"}, "the world .math:make: cannot be imported"),
        ({"world": "math:make"}, "the module math has no function 'make'"),
        ({"num_instances": 501}, "501 instances were asked for; the validation set"),
        ({"instances": "exam"}, "'exam' is not a set of instances"),
    ],
)
def test_bad_experiments(changes, message):
    with pytest.raises(InputError, match=message):
        experiment(**changes)
