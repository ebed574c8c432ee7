"""The policy RHP, against worlds and values made by hand."""

import numpy as np
import pytest

from rhp_drake.planning.policy import PolicyError
from rhp_drake.planning.receding_horizon import (
    RecedingHorizon,
    sample_softmax,
)
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import (
    FAILURE_VALUE,
    TABLE_UPPER,
    Action,
    allowed_actions,
    hand_targets,
    object_positions,
)

# One box in the middle of the hand, which looks along x.
STATE = np.array([0.40, 0.0, 0.0, 0.40, 0.0, 0.0])


def goal_after(num_actions: int) -> np.ndarray:
    """A goal whose region the box enters with so many actions forward."""
    return np.array([[0.40 + 0.05 * num_actions + 0.055, 0.0]])


class CarryingModel:
    """A push model in which the box sticks to the hand; it counts what it simulates."""

    def __init__(self):
        self.batch_sizes = []

    def step(self, states, actions):
        self.batch_sizes.append(len(states))
        targets = hand_targets(states, actions)
        after = states.copy()
        after[:, :3] = targets
        after[:, 3:5] += targets[:, :2] - states[:, :2]
        return after


class Constant:
    """The same values everywhere."""

    def __init__(self, *values):
        self._values = np.array(values, dtype=float)

    def values(self, states, goals):
        return np.tile(self._values, (len(states), 1))


# Sure that forward is right, and that it is worth -9.
FORWARD = Constant(-9, -99, -99, -99, -99, -99)
UNDECIDED = Constant(*[-9] * 6)


def rhp(value_function, n=6, h=6, temperature=0.1, model=None, discount=1.0):
    model = model or CarryingModel()
    return RecedingHorizon(model, value_function, n, h, temperature, discount)


def test_softmax_frequencies_are_those_of_eq_5():
    temperature = 0.7
    q = np.array([-3.0, -4.0, -3.5, -np.inf, -6.0, -3.0])
    weights = np.exp(q / temperature)
    expected = weights / weights.sum()
    num_draws = 100_000
    draws = sample_softmax(np.tile(q, (num_draws, 1)), temperature, stream(0))
    frequencies = np.bincount(draws, minlength=6) / num_draws
    deviations = np.sqrt(expected * (1 - expected) / num_draws)
    assert (np.abs(frequencies - expected) <= 4 * deviations).all()
    assert frequencies[3] == 0


def test_softmax_of_hopeless_values():
    """Neither overflow nor underflow, however bad or far apart the values are."""
    q = np.array([[-1e4, -1e4 - 1e3, -np.inf, -np.inf, -np.inf, -np.inf]])
    assert sample_softmax(q, 0.01, stream(0)) == [0]


@pytest.mark.parametrize("num_actions", [1, 2, 5])
def test_return_of_reaching_the_goal_is_the_number_of_actions(num_actions):
    decision = rhp(FORWARD).decide(STATE, goal_after(num_actions), stream(0))
    assert decision.action == Action.FORWARD
    assert decision.value == -num_actions
    np.testing.assert_array_equal(decision.returns, np.full(6, -num_actions))
    # A roll-out ends at the goal.
    assert decision.roll_outs.shape == (6, num_actions + 1, 6)
    xs = object_positions(decision.roll_outs)[0, :, 0, 0]
    np.testing.assert_allclose(np.diff(xs), 0.05)


def test_return_short_of_the_goal_ends_with_the_value():
    decision = rhp(FORWARD, h=2).decide(STATE, goal_after(5), stream(0))
    assert decision.value == -2 - 9


def test_discounted_return():
    policy = rhp(FORWARD, h=2, discount=0.5)
    decision = policy.decide(STATE, goal_after(5), stream(0))
    assert decision.value == pytest.approx(-1 - 0.5 + 0.25 * -9)


def test_best_roll_out_is_executed():
    """Only roll-outs tell what to do where all values are the same."""
    policy = rhp(UNDECIDED, n=60, h=2)
    decision = policy.decide(STATE, goal_after(1), stream(0))
    assert decision.action == Action.FORWARD
    assert decision.value == -1
    assert set(decision.returns) == {-1, -2 - 9}


def test_losing_the_box_is_worse_than_never_arriving():
    state = STATE.copy()
    state[3:5] = [0.40, TABLE_UPPER[1] - 0.02]
    leftward = Constant(-99, -99, -9, -99, -99, -99)
    decision = rhp(leftward).decide(state, goal_after(5), stream(0))
    assert decision.value == FAILURE_VALUE - 1


@pytest.mark.parametrize("value", [-36.0, -70.0])
def test_the_box_is_not_lost_however_bad_the_values_are(value):
    state = STATE.copy()
    state[3:5] = [0.40, TABLE_UPPER[1] - 0.02]
    undecided = Constant(*[value] * 6)
    for seed in range(20):
        decision = rhp(undecided, n=60, h=2).decide(state, goal_after(5), stream(seed))
        lost = object_positions(decision.roll_outs)[:, -1, 0, 1] > TABLE_UPPER[1]
        assert lost.any()
        assert (decision.returns[lost] < decision.returns[~lost].min()).all()
        assert decision.value == value - 2


def test_masked_actions_are_never_drawn():
    corner = STATE.copy()
    corner[:2] = [0.78, 0.28]  # Neither forward nor left.
    for seed in range(20):
        decision = rhp(UNDECIDED).decide(corner, goal_after(-9), stream(seed))
        assert allowed_actions(corner)[decision.action]
        hands = decision.roll_outs[..., :2]
        assert (hands <= 0.80 + 0.001).all()
        assert (hands[..., 1] <= 0.30 + 0.001).all()


def test_no_action_left():
    outside = STATE.copy()
    outside[:2] = 5.0
    for horizon in (0, 3):
        with pytest.raises(PolicyError, match="workspace"):
            rhp(UNDECIDED, h=horizon).decide(outside, goal_after(5), stream(0))


def test_without_horizon_it_is_greedy():
    model = CarryingModel()
    greedy = rhp(Constant(-5, -3, -4, -9, -9, -9), n=0, h=0, model=model)
    decision = greedy.decide(STATE, goal_after(5), stream(0))
    assert (decision.action, decision.value) == (Action.BACKWARD, -3)
    assert len(decision.roll_outs) == 0
    assert model.batch_sizes == []
    border = STATE.copy()
    border[0] = 0.21  # Not backward.
    assert greedy.decide(border, goal_after(5), stream(0)).action == Action.LEFT


def test_same_generator_same_decision():
    policy = rhp(UNDECIDED)
    first, again, other = (
        policy.decide(STATE, goal_after(5), stream(seed, "decision"))
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.roll_outs, again.roll_outs)
    np.testing.assert_array_equal(first.returns, again.returns)
    assert first.action == again.action
    assert (first.roll_outs != other.roll_outs).any()


def test_equal_pairs_are_simulated_once():
    model = CarryingModel()
    decision = rhp(FORWARD, n=50, h=3, model=model).decide(
        STATE, goal_after(9), stream(0)
    )
    assert model.batch_sizes == [1, 1, 1]
    assert decision.roll_outs.shape == (50, 4, 6)

    model = CarryingModel()
    policy = rhp(UNDECIDED, n=50, h=2, model=model)
    decision = policy.decide(STATE, goal_after(9), stream(0))
    assert model.batch_sizes[0] == 6
    distinct = len(np.unique(decision.roll_outs[:, 1:].reshape(50, -1), axis=0))
    assert distinct - 6 <= model.batch_sizes[1] <= 36
    # Every roll-out got its own pair's result.
    for states in decision.roll_outs:
        moves = object_positions(states)[:, 0] - states[:, :2]
        np.testing.assert_allclose(moves, 0, atol=1e-12)


class RefusingModel:
    """A push model that refuses all states."""

    def step(self, states, actions):
        raise PushModelError("bodies deep inside each other.")


def test_greedy_where_the_model_refuses_the_state():
    values = Constant(-9, -99, -5, -99, -99, -99)
    decision = rhp(values, model=RefusingModel()).decide(
        STATE, goal_after(3), stream(0)
    )
    assert (decision.action, decision.value) == (2, -5)
    assert not len(decision.roll_outs)


def test_nothing_is_decided_in_a_state_that_is_not_finite():
    state = STATE.copy()
    state[4] = np.nan
    for horizon in (0, 6):
        with pytest.raises(PolicyError, match="the state is not finite"):
            rhp(FORWARD, h=horizon).decide(state, goal_after(3), stream(0))
