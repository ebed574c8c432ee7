"""Eq. 4 on cases made by hand: each setting of the learner changes what it says."""

import math

import numpy as np
import pytest
import torch

from rhp_drake.errors import WorkError
from rhp_drake.learning.augmentation import NoSymmetry, Symmetry
from rhp_drake.learning.dataset import Dataset
from rhp_drake.learning.demonstration_folder import describe
from rhp_drake.learning.demonstrators import Acting
from rhp_drake.learning.fitted_q import FittedQ, FittedQConfig
from rhp_drake.learning.reinforcement import Reinforcement, Rounds
from rhp_drake.learning.sampling import Samples
from rhp_drake.random_streams import stream
from rhp_drake.task import Action, allowed_actions, hand_targets
from rhp_drake.value.q_network import PaperQNetwork, QNetwork

# One box in the middle of the hand, which pushes it along x: two actions.
WAY = np.array([[0.40 + x, 0.0, 0.0, 0.40 + x, 0.0, 0.0] for x in (0.0, 0.05, 0.10)])
FAR_AWAY = np.array([[0.40, 0.25]])
ONLINE = (-9.0, -5.0, -8.0, -8.0, -8.0, -8.0)
TARGET = (-4.0, -7.0, -6.0, -6.0, -6.0, -6.0)


class OneForAll(QNetwork):
    """The same six values in every state."""

    architecture = "one for all"

    def __init__(self, values=ONLINE):
        super().__init__(num_objects=1)
        self.of_actions = torch.nn.Parameter(torch.tensor(values))

    def forward(self, states, goals):
        return self.of_actions.expand(len(states), -1)


def data(way=WAY, goals=FAR_AWAY) -> Dataset:
    """One task, in whose search the states of the way followed each other."""
    way = way.astype(np.float32)
    num_actions = len(way) - 1
    return Dataset(
        goals=goals[None],
        plan_tasks=np.zeros(num_actions, int),
        plan_states=way[:-1],
        plan_actions=np.zeros(num_actions, int),
        plan_actions_left=np.arange(num_actions, 0, -1),
        search_tasks=np.zeros(num_actions, int),
        search_states=way[:-1],
        search_actions=np.full(num_actions, int(Action.FORWARD)),
        search_next_states=way[1:],
        search_origins=np.arange(num_actions) - 1,
        solved=np.array([True]),
    )


def learner(source=None, **config) -> FittedQ:
    """Its own network values as `ONLINE`, the target network as `TARGET`."""
    settings = {"hindsight": 0.0, "symmetry": False, "batch_size": 4} | config
    made = FittedQ(
        OneForAll(TARGET), [source or data()], FittedQConfig(**settings), stream(0)
    )
    with torch.no_grad():
        made.network.of_actions.copy_(torch.tensor(ONLINE))
    return made


def targets(made: FittedQ, least=-np.inf) -> torch.Tensor:
    """Of the first action of the way."""
    batch = Samples(
        WAY[:1], np.zeros(1, int), WAY[1:2], FAR_AWAY[None], np.array([least])
    )
    return made._targets(batch, NoSymmetry(), torch.from_numpy(batch.goals).float())


def test_double_q_takes_the_networks_choice_at_the_target_networks_price():
    assert targets(learner()).item() == -1 - 7


def test_without_double_q_the_target_network_chooses_too():
    assert targets(learner(double_q=False)).item() == -1 - 4


def test_known_returns_bound_the_target_from_below():
    assert targets(learner(), least=-2.0).item() == -2
    assert targets(learner(), least=-20.0).item() == -8


def test_a_discount_shrinks_what_comes_later():
    assert targets(learner(discount=0.5)).item() == -1 - 0.5 * 7


@pytest.mark.parametrize(
    ("squared", "expected"), [(True, 1.0), (False, 0.5)], ids=["squared", "huber"]
)
def test_small_errors(squared, expected):
    """The action's value is -9, its target -8."""
    loss = learner(squared_errors=squared)._loss()
    assert loss.item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("squared", "expected"), [(True, 36.0), (False, 5.5)], ids=["squared", "huber"]
)
def test_large_errors(squared, expected):
    made = learner(squared_errors=squared)
    with torch.no_grad():
        made.network.of_actions[0] = -14.0
    assert made._loss().item() == pytest.approx(expected)


def test_nothing_is_asked_of_states_at_the_goal():
    at_the_goal = data(goals=WAY[0, 3:5][None])
    assert learner(at_the_goal)._loss().item() == 0


def test_goals_in_hindsight_are_worth_the_way_that_was_taken():
    """One action or two, while the values say 30 and the task's own goal is far."""
    losses = []
    for hindsight in (0.0, 1.0):
        made = learner(hindsight=hindsight, batch_size=64)
        with torch.no_grad():
            made.network.of_actions.fill_(-30.0)
            made._target.of_actions.fill_(-30.0)
        losses.append(made._loss().item())
    assert losses[0] == 0.5
    # Of some samples nothing is asked: their states are at the new goal already.
    assert losses[1] > 10


def test_the_target_network_follows():
    made = learner(target_rate=0.25)
    made.step()
    expected = torch.tensor(TARGET).lerp(made.network.of_actions.detach(), 0.25)
    torch.testing.assert_close(made._target.of_actions.detach(), expected)


def test_regularisation_pulls_weights_to_zero():
    at_the_goal = data(goals=WAY[0, 3:5][None])
    for l2, pulled in ((0.0, False), (1e-6, True)):
        made = learner(at_the_goal, l2=l2)
        made.step()
        change = made.network.of_actions.detach() - torch.tensor(ONLINE)
        assert bool((change > 0).all()) == pulled


def test_the_learning_rate_falls_as_a_cosine():
    made = learner(learning_rate=0.1, num_steps=8)
    for step in range(8):
        (rate,) = (group["lr"] for group in made._optimizer.param_groups)
        assert rate == pytest.approx(0.05 * (1 + math.cos(math.pi * step / 8)))
        made.step()


def test_a_gradient_that_is_not_finite_changes_nothing():
    made = learner()
    made.network.of_actions.register_hook(lambda gradient: gradient * torch.inf)
    with pytest.raises(WorkError, match="the gradient of step 0 is not finite"):
        made.step()
    torch.testing.assert_close(made.network.of_actions.detach(), torch.tensor(ONLINE))
    assert made.num_steps == 0


def test_masks_are_mirrored_like_what_they_mask():
    """At the border of the workspace, where actions are missing."""
    generator = stream(4)
    states = np.tile(WAY[0], (400, 1))
    states[:, 0] = generator.uniform(0.20, 0.80, len(states))
    states[:, 1] = generator.choice([-0.29, 0.29], len(states))
    states[:, 2] = generator.uniform(-np.pi, np.pi, len(states))
    symmetry = Symmetry(len(states), 1, generator, torch.device("cpu"))
    masks = allowed_actions(states)
    assert not masks.all()
    seen_masks = symmetry.action_masks(torch.from_numpy(masks)).numpy()
    seen = symmetry.states(torch.from_numpy(states)).numpy()
    np.testing.assert_array_equal(seen_masks, allowed_actions(seen))


@pytest.mark.parametrize("executed_only", [True, False])
def test_executed_transitions_push_out_old_ones(executed_only, tmp_path):
    """The paper's replay buffer keeps its size; ours keeps all."""
    config = FittedQConfig(num_steps=2, batch_size=8)
    made = FittedQ(PaperQNetwork(1), [data()], config, stream(0))
    acting = Acting(executed_only=executed_only, horizon=1)
    rounds = Rounds(num_tasks=1, num_steps=2, acting=acting)
    work = Reinforcement(made, rounds, tmp_path, 0, 1, "commit")
    list(work.act())
    sizes = [len(source.search_actions) for source in made.sources]
    if executed_only:
        assert sizes == [2]
        latest = work._experience[0].search_states[-2:]
        np.testing.assert_array_equal(made.sources[0].search_states, latest)
    else:
        assert sizes == [2, work.num_transitions]


def test_the_network_that_learns_is_the_one_that_acts(tmp_path):
    torch.manual_seed(0)
    config = FittedQConfig(num_steps=4, batch_size=8)
    made = FittedQ(PaperQNetwork(1), [data()], config, stream(0))
    rounds = Rounds(num_tasks=1, num_steps=2)
    work = Reinforcement(made, rounds, tmp_path, 0, 1, "commit")
    for index in range(2):
        list(work.act())
        acted = describe(tmp_path / f"round_{index:04d}")["demonstrator"]
        assert repr(made.network) in acted
        assert (repr(made._target) in acted) == (index == 0)
        made.step()
        made.step()


def test_pushing_moves_the_hand_as_the_way_says():
    """The way above is one that the hand can go."""
    forward = np.full(2, int(Action.FORWARD))
    np.testing.assert_allclose(hand_targets(WAY[:-1], forward), WAY[1:, :3])
