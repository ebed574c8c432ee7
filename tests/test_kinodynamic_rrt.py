"""The kinodynamic RRT: its plans are true, its searches repeatable."""

import itertools

import numpy as np
import pytest

from rhp_drake.planning.kinodynamic_rrt import fewest_actions_left, plan
from rhp_drake.planning.open_loop import OpenLoop
from rhp_drake.planning.policy import PolicyError
from rhp_drake.planning.search import leads_to_goal
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.task import GOAL_RADIUS, goals_reached, sample_instance


@pytest.fixture(scope="module")
def push_model():
    return PushModel(3)


def search(push_model, index, **limits):
    instance = sample_instance(stream(5, TRAINING, index))
    found = plan(
        push_model,
        instance.initial_state,
        instance.goals,
        stream(5, "plan", index),
        **limits,
    )
    return instance, found


def test_plans_lead_to_the_goal_when_replayed(push_model):
    solved = 0
    for index in range(12):
        instance, found = search(push_model, index, max_transitions=2000)
        np.testing.assert_array_equal(found.states[0], instance.initial_state)
        if found.actions is None:
            assert len(found.states) == 1
            continue
        solved += 1
        assert leads_to_goal(push_model, instance, found.actions)
        before, after = found.states[:-1], found.states[1:]
        assert not goals_reached(before, instance.goals).any()
        np.testing.assert_array_equal(push_model.step(before, found.actions), after)
    assert solved >= 9


def test_searches_are_repeatable_and_their_transitions_true(push_model):
    instance, found = search(push_model, 3, max_transitions=600)
    _, again = search(push_model, 3, max_transitions=600)
    for name, array in vars(found.search).items():
        np.testing.assert_array_equal(array, getattr(again.search, name), err_msg=name)
    s = found.search
    np.testing.assert_array_equal(push_model.step(s.states, s.actions), s.next_states)
    for state, origin in zip(s.states, s.origins, strict=True):
        before = instance.initial_state if origin < 0 else s.next_states[origin]
        np.testing.assert_array_equal(state, before)


@pytest.mark.parametrize(("index", "limit"), [(1, 2000), (3, 600)])
def test_being_told_of_growth_changes_nothing(push_model, index, limit):
    instance, found = search(push_model, index, max_transitions=limit)
    growths = []
    _, again = search(
        push_model, index, max_transitions=limit, on_growth=growths.append
    )
    np.testing.assert_array_equal(again.states, found.states)
    np.testing.assert_array_equal(again.actions, found.actions)
    for name, array in vars(found.search).items():
        np.testing.assert_array_equal(array, getattr(again.search, name), err_msg=name)

    last = growths[-1]
    assert last.num_transitions == len(found.search.actions)
    for tree in range(1, last.num_trees + 1):
        of_tree = [growth for growth in growths if growth.num_trees == tree]
        children = sum(len(growth.children) for growth in of_tree)
        assert of_tree[-1].num_nodes == 1 + children
    length = None if found.actions is None else len(found.actions)
    assert last.plan_length == length
    np.testing.assert_array_equal(growths[0].source, instance.initial_state)
    simulated = {tuple(state) for state in found.search.next_states}
    assert all(tuple(c) in simulated for growth in growths for c in growth.children)


def test_growth_counts_trees(push_model, monkeypatch):
    monkeypatch.setattr("rhp_drake.planning.kinodynamic_rrt._RESTART", 20)
    growths = []
    search(push_model, 3, max_transitions=100, on_growth=growths.append)
    numbers = [growth.num_trees for growth in growths]
    assert numbers == sorted(numbers)
    assert numbers[0] == 1
    assert numbers[-1] >= 4
    # Each begins with its root and what came from it.
    for before, after in itertools.pairwise(growths):
        if after.num_trees > before.num_trees:
            assert after.num_nodes == 1 + len(after.children)


def test_improvement_shortens_plans_and_ends_in_time(push_model):
    saved = 0
    for index in range(6):
        _, first = search(push_model, index, improvement=0)
        _, better = search(push_model, index, improvement=400)
        assert 0 < first.first_seconds <= first.seconds
        assert 0 < better.first_seconds < better.seconds
        # The search is the same until the first plan.
        n = len(first.search.actions)
        np.testing.assert_array_equal(
            better.search.next_states[:n], first.search.next_states
        )
        assert len(better.search.actions) < n + 400 + 6
        assert len(better.actions) <= len(first.actions)
        saved += len(first.actions) - len(better.actions)
    assert saved > 0


def test_fewest_actions_left_by_hand():
    state = np.zeros(12)
    goals = np.zeros((3, 2))
    left = []
    for distance in (0.0, GOAL_RADIUS, GOAL_RADIUS + 0.04, GOAL_RADIUS + 0.06):
        state[3] = distance
        left.append(fewest_actions_left(state, goals))
    np.testing.assert_array_equal(left, [0, 0, 1, 2])


def test_limit_of_transitions(push_model):
    for index in range(6):
        _, found = search(push_model, index, max_transitions=30)
        assert len(found.search.actions) < 30 + 6
        assert np.isnan(found.first_seconds) == (found.actions is None)


def test_a_hand_that_may_not_move_has_no_plan(push_model):
    instance = sample_instance(stream(5, TRAINING, 0))
    state = instance.initial_state.copy()
    state[0] = -1.0
    found = plan(push_model, state, instance.goals, stream(0))
    assert found.actions is None
    assert len(found.search.actions) == 0


def test_open_loop_executes_its_plan_and_no_more(push_model):
    instance, found = search(push_model, 1)
    policy = OpenLoop(push_model)
    memory, actions = None, []

    def decide():
        return policy.decide(
            instance.initial_state, instance.goals, stream(5, "plan", 1), memory
        )

    for _ in found.actions:
        decision = decide()
        actions.append(decision.action)
        np.testing.assert_array_equal(
            decision.roll_outs, found.states[None, len(actions) - 1 :]
        )
        memory = decision.memory
    np.testing.assert_array_equal(actions, found.actions)
    with pytest.raises(PolicyError, match="plan has ended"):
        decide()


def test_no_plan_in_no_time(push_model):
    instance = sample_instance(stream(5, TRAINING, 0))
    with pytest.raises(PolicyError, match="no plan"):
        OpenLoop(push_model, time_limit=0.0).decide(
            instance.initial_state, instance.goals, stream(0)
        )
