"""Best-first search guided by a value function."""

import numpy as np
import pytest
import torch

from rhp_drake.planning.best_first import plan_best_first
from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.planning.search import leads_to_goal
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.resources import models_path
from rhp_drake.task import TaskInstance, goals_reached, sample_instance
from rhp_drake.value.q_network import PaperQNetwork
from rhp_drake.value.weights import load_q_network


@pytest.fixture(scope="module")
def push_model():
    return PushModel(3)


@pytest.fixture(scope="module")
def q_network():
    return load_q_network(models_path() / "q_network/best.safetensors", 3)


def test_plans_lead_to_the_goal_when_replayed(push_model, q_network):
    for index in range(8):
        instance = sample_instance(stream(5, TRAINING, index))
        found = plan_best_first(
            push_model, q_network, instance.initial_state, instance.goals
        )
        np.testing.assert_array_equal(found.states[0], instance.initial_state)
        assert leads_to_goal(push_model, instance, found.actions)
        before, after = found.states[:-1], found.states[1:]
        assert not goals_reached(before, instance.goals).any()
        # A batch may hold the pair at another place.
        np.testing.assert_array_equal(push_model.step(before, found.actions), after)
        s = found.search
        for before, origin in zip(s.states, s.origins, strict=True):
            expected = instance.initial_state if origin < 0 else s.next_states[origin]
            np.testing.assert_array_equal(before, expected)


class Favourite:
    """A value function that sees one action left, if it is this one."""

    def __init__(self, action):
        self._action = action

    def values(self, states, goals):
        q = np.full((len(states), 6), -30.0)
        q[:, self._action] = -1.0
        return q


def test_the_most_promising_action_is_simulated_first(push_model):
    instance = sample_instance(stream(5, TRAINING, 0))
    found = plan_best_first(
        push_model,
        Favourite(4),
        instance.initial_state,
        instance.goals,
        max_transitions=12,
    )
    # The root's six actions are simulated together; then the favourite's own.
    assert found.search.actions[0] == 4
    assert found.search.origins[6] == 0
    assert found.search.actions[6] == 4


def test_limits(push_model):
    torch.manual_seed(0)
    untrained = PaperQNetwork(3)
    instance = sample_instance(stream(5, TRAINING, 1))
    arguments = (push_model, untrained, instance.initial_state, instance.goals)
    found = plan_best_first(*arguments, max_transitions=30)
    assert len(found.search.actions) < 30 + 6
    found = plan_best_first(*arguments, time_limit=0.0)
    assert found.actions is None
    assert np.isnan(found.first_seconds)
    np.testing.assert_array_equal(found.states, instance.initial_state[None])


def test_a_goal_state_needs_no_actions(push_model, q_network):
    instance = sample_instance(stream(5, TRAINING, 1))
    goals = instance.initial_state[3:].reshape(-1, 3)[:, :2]
    found = plan_best_first(push_model, q_network, instance.initial_state, goals)
    assert len(found.actions) == 0
    assert found.first_seconds == found.seconds


def test_a_goal_state_is_found_beside_one_that_just_misses(push_model):
    """Searches take states that differ by less than a centimetre for the same."""
    instance = sample_instance(stream(5, TRAINING, 0))
    state, goals = instance.initial_state, instance.goals.copy()
    # The target is half a millimetre outside.
    goals[0] = state[3] + 0.0605, state[4]

    class Creep:
        """Each action moves the target by a millimetre."""

        def step(self, states, actions):
            children = states.copy()
            children[:, 3] += 0.001
            return children

    found = plan_best_first(Creep(), Favourite(4), state, goals, max_transitions=12)
    assert len(found.actions) == 1


def test_an_obstacle_that_is_far_out_is_brought_back(push_model, q_network):
    # The target is home, and an obstacle 12 cm away from where it belongs.
    state = np.array([0.3, 0, 0, 0.6, 0, 0, 0.42, 0, 0, 0.3, -0.2, 0])
    goals = np.array([[0.6, 0.0], [0.54, 0.0], [0.3, -0.2]])
    task = TaskInstance(state, goals)
    found = plan_best_first(push_model, q_network, state, goals)
    assert leads_to_goal(push_model, task, found.actions)
    found = plan(push_model, state, goals, stream(0), max_transitions=3000)
    assert leads_to_goal(push_model, task, found.actions)
