"""Demonstrations, imitation and fitted Q."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rhp_drake.errors import InputError, WorkError
from rhp_drake.learning.augmentation import Symmetry
from rhp_drake.learning.dataset import load_dataset
from rhp_drake.learning.demonstration_folder import demonstrate_tasks
from rhp_drake.learning.demonstrators import PlanningDemonstrator
from rhp_drake.learning.fitted_q import FittedQ, FittedQConfig, double_q_targets
from rhp_drake.learning.imitation import (
    Imitation,
    ImitationConfig,
    imitation_targets,
    return_of,
)
from rhp_drake.learning.reinforcement import Reinforcement, Rounds
from rhp_drake.learning.sampling import _go_back, sample
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.task import (
    Action,
    goals_reached,
    hand_targets,
    object_positions,
)
from rhp_drake.value.q_network import ARCHITECTURES, PaperQNetwork

DEMONSTRATOR = PlanningDemonstrator(seed=11, num_objects=3)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("demonstrations")
    list(demonstrate_tasks(path, range(25), DEMONSTRATOR, 1))
    return load_dataset([path])


def test_eq_2():
    left = torch.tensor([1.0, 3.0])
    torch.testing.assert_close(return_of(left, 1.0), torch.tensor([-1.0, -3.0]))
    torch.testing.assert_close(return_of(left, 0.5), torch.tensor([-1.0, -1.75]))


def test_eq_3_grounds_only_what_looks_better_than_the_plan():
    q = torch.tensor([[-5.0, -2.0, -3.0, -9.0, -3.1, 0.0]])
    targets = imitation_targets(
        q, torch.tensor([0]), torch.tensor([3.0]), margin=4, discount=1.0
    )
    # The plan's action 0 is worth -3; at or above that, -7; else as it is.
    expected = torch.tensor([[-3.0, -7.0, -7.0, -9.0, -3.1, -7.0]])
    torch.testing.assert_close(targets, expected)


def test_imitation_learns_the_plans(data):
    torch.manual_seed(0)
    config = ImitationConfig(num_steps=60)
    learner = Imitation(PaperQNetwork(3), data, config, stream(0))
    learner.step()
    first = learner.mean_loss
    for _ in range(59):
        learner.step()
    learner.step()
    assert learner.mean_loss < 0.7 * first


def test_a_loss_that_is_not_finite_stops_training(data):
    torch.manual_seed(0)
    network = PaperQNetwork(3)
    learner = Imitation(network, data, ImitationConfig(), stream(0))
    learner.step()
    with torch.no_grad():
        network.layers[0].weight[0, 0] = torch.nan
    with pytest.raises(WorkError, match="the loss of step 1 is nan"):
        learner.step()
    assert learner.num_steps == 1


def test_double_q_targets_by_hand():
    q_next = torch.tensor([[0.0, 5, 1, 1, 1, 1]] * 4)
    target_q_next = torch.tensor([[-3.0, -7, -100, 0, 0, 0]] * 4)
    allowed = torch.ones(4, 6, dtype=torch.bool)
    allowed[1, 1] = False  # Then action 2 is the best, worth less than all is.
    targets = double_q_targets(
        q_next,
        target_q_next,
        allowed,
        reached=torch.tensor([False, False, True, False]),
        fallen=torch.tensor([False, False, False, True]),
        discount=1.0,
    )
    torch.testing.assert_close(targets, torch.tensor([-8.0, -41.0, -1.0, -41.0]))


def test_hindsight_goals_are_reached_in_time(data):
    """Following the search from a sample to its end meets the goals it was given."""
    samples = sample([data], 4000, stream(1), hindsight=0.5)
    known = np.isfinite(samples.least_returns)
    assert known.mean() > 0.05
    # One action is enough where the least return says so.
    one = known & (samples.least_returns == -1.0)
    assert one.sum() > 10
    assert goals_reached(samples.next_states[one], samples.goals[one]).all()
    push_model = PushModel(3)
    after = push_model.step(
        samples.states[:200].astype(float), samples.actions[:200].astype(int)
    )
    difference = object_positions(after) - object_positions(samples.next_states[:200])
    assert np.median(np.abs(difference)) < 1e-5


def test_hindsight_counts_actions(data):
    """From each transition, so many actions lead to the end."""
    ends = np.arange(len(data.search_actions))
    rows, num_actions = _go_back(data, ends, stream(1))
    assert num_actions.max() > 3
    for row, count, end in zip(rows, num_actions, ends, strict=True):
        way = [end]
        while way[-1] != row:
            way.append(data.search_origins[way[-1]])
        assert len(way) == count


def test_the_loss_of_imitation_may_stay(data):
    """It is the sum of both, on the same batches."""

    def loss(weight):
        torch.manual_seed(0)
        config = FittedQConfig(batch_size=64, imitation_weight=weight)
        return FittedQ(PaperQNetwork(3), [data], config, stream(3))._loss().item()

    alone, half, whole = loss(0.0), loss(0.5), loss(1.0)
    assert whole - alone == pytest.approx(2 * (half - alone), rel=1e-3)
    assert whole > alone


def test_symmetries_are_those_of_the_task(data):
    rows = np.arange(200)
    states = data.search_states[rows].astype(float)
    actions = data.search_actions[rows].astype(int)
    goals = data.goals[data.search_tasks[rows]]
    symmetry = Symmetry(len(rows), 3, stream(2), torch.device("cpu"))
    seen = symmetry.states(torch.from_numpy(states)).numpy()
    seen_actions = symmetry.actions(torch.from_numpy(actions)).numpy()
    seen_goals = symmetry.goals(torch.from_numpy(goals)).numpy()
    assert set(np.unique(seen_actions)) <= set(Action)
    # The hand goes where the mirror image of the hand goes...
    moved = states.copy()
    moved[:, :3] = hand_targets(states, actions)
    expected = symmetry.states(torch.from_numpy(moved)).numpy()[:, :3]
    np.testing.assert_allclose(hand_targets(seen, seen_actions), expected, atol=1e-9)
    # ...and objects keep their distances to their goals, the target its place.
    ways = np.linalg.norm(object_positions(states) - goals, axis=-1)
    seen_ways = np.linalg.norm(object_positions(seen) - seen_goals, axis=-1)
    np.testing.assert_allclose(seen_ways[:, 0], ways[:, 0])
    np.testing.assert_allclose(np.sort(seen_ways[:, 1:]), np.sort(ways[:, 1:]))


LEARNERS = [
    (FittedQ, FittedQConfig(num_steps=8, batch_size=64)),
    (FittedQ, FittedQConfig(num_steps=8, batch_size=64, imitation_weight=0.1)),
    (Imitation, ImitationConfig(num_steps=8, batch_size=64)),
]


@pytest.mark.parametrize("architecture", ARCHITECTURES.values())
@pytest.mark.parametrize(
    ("kind", "config"), LEARNERS, ids=["fitted_q", "both", "imitation"]
)
def test_all_is_computed_where_the_network_is(kind, config, architecture, data):
    """On a GPU, for example; the meta device has shapes only, and refuses others."""
    network = architecture(3).to("meta")
    source = [data] if kind is FittedQ else data
    loss = kind(network, source, config, stream(3))._loss()
    assert loss.device.type == "meta"
    loss.backward()


@pytest.mark.parametrize(
    ("kind", "config"), LEARNERS, ids=["fitted_q", "both", "imitation"]
)
def test_training_goes_on_from_a_checkpoint_as_if_never_stopped(
    kind, config, data, tmp_path
):
    def learner():
        torch.manual_seed(0)
        network = PaperQNetwork(3)
        source = [data] if kind is FittedQ else data
        return network, kind(network, source, config, stream(3))

    network, straight = learner()
    for _ in range(8):
        straight.step()
    _, stopped = learner()
    for _ in range(3):
        stopped.step()
    stopped.save(tmp_path / "checkpoint", {"seed": 3})
    resumed_network, resumed = learner()
    resumed.resume(tmp_path / "checkpoint", {"seed": 3})
    for _ in range(5):
        resumed.step()
    for ours, theirs in zip(
        network.parameters(), resumed_network.parameters(), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)
    assert resumed.mean_loss == straight.mean_loss

    (tmp_path / "corrupt").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="corrupt"):
        resumed.resume(tmp_path / "corrupt", {"seed": 3})
    source = [data] if kind is FittedQ else data
    other = kind(network, source, replace(config, discount=0.9), stream(3))
    with pytest.raises(InputError, match="other work"):
        other.resume(tmp_path / "checkpoint", {"seed": 3})
    with pytest.raises(InputError, match="other work"):
        resumed.resume(tmp_path / "checkpoint", {"seed": 4})


def test_reinforcement_goes_on_as_if_never_stopped(data, tmp_path):
    config = FittedQConfig(num_steps=6, batch_size=64)
    rounds = Rounds(num_tasks=2, num_steps=3)

    def learn(folder, stops_at=None):
        torch.manual_seed(0)
        learner = FittedQ(PaperQNetwork(3), [data], config, stream(3))
        checkpoint = tmp_path / "checkpoint"
        if stops_at is None and folder.exists():
            learner.resume(checkpoint, {})
        reinforcement = Reinforcement(learner, rounds, folder, 3, 1, "commit")
        while learner.num_steps < config.num_steps:
            for done in reinforcement.act():
                if stops_at == (learner.num_steps, done):
                    return learner
            learner.step()
            learner.save(checkpoint, {})
            if stops_at == learner.num_steps:
                return learner
        assert len(learner.sources[1].goals) == 4
        return learner

    straight = learn(tmp_path / "straight")
    for name, stop in (("learning", 4), ("acting", (3, 1))):
        learn(tmp_path / name, stop)
        resumed = learn(tmp_path / name)
        for ours, theirs in zip(
            straight.network.parameters(), resumed.network.parameters(), strict=True
        ):
            torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


def test_rounds_must_fit(data, tmp_path):
    learner = FittedQ(PaperQNetwork(3), [data], FittedQConfig(num_steps=5), stream(3))
    with pytest.raises(InputError, match="5 steps are no whole number of rounds of 3"):
        Reinforcement(learner, Rounds(num_steps=3), tmp_path, 3, 1, "commit")
