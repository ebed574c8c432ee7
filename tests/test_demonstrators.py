"""Who demonstrates: RHP with its roll-outs, and the guided search."""

import numpy as np
import torch

from rhp_drake.learning.demonstrators import (
    Acting,
    GuidedDemonstrator,
    PlanningDemonstrator,
    RecedingHorizonDemonstrator,
)
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.resources import models_path
from rhp_drake.task import MAX_ACTIONS, allowed_actions, goals_reached
from rhp_drake.value.q_network import PaperQNetwork
from rhp_drake.value.weights import load_q_network


def equal(made, again):
    np.testing.assert_array_equal(made.actions, again.actions)
    np.testing.assert_array_equal(made.states, again.states)
    for name, array in vars(made.search).items():
        np.testing.assert_array_equal(array, getattr(again.search, name), err_msg=name)


def test_rhp_demonstrates_with_all_its_roll_outs():
    torch.manual_seed(0)
    network = PaperQNetwork(3)
    made, again = (
        RecedingHorizonDemonstrator(11, network).demonstrate(2) for _ in range(2)
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


def test_rhp_may_keep_what_was_executed_alone():
    torch.manual_seed(0)
    network = PaperQNetwork(3)
    whole = RecedingHorizonDemonstrator(11, network).demonstrate(2)
    executed = RecedingHorizonDemonstrator(11, network, Acting(executed_only=True))
    search = executed.demonstrate(2).search
    assert 0 < len(search.actions) <= MAX_ACTIONS < len(whole.search.actions)
    np.testing.assert_array_equal(search.origins, np.arange(len(search.actions)) - 1)
    np.testing.assert_array_equal(search.next_states[:-1], search.states[1:])
    # It acted alike.
    np.testing.assert_array_equal(search.states[0], whole.instance.initial_state)
    assert pairs_of(search) <= pairs_of(whole.search)


def test_epsilon_rhp_is_rhp_but_for_a_share_of_its_actions():
    """Its draws say when it explores; else it does what RHP does."""
    network = load_q_network(models_path() / "q_network/best.safetensors", 3)
    acting = Acting(epsilon=0.5, num_roll_outs=2, horizon=2)
    made = RecedingHorizonDemonstrator(11, network, acting).demonstrate(2)
    policy = RecedingHorizon(PushModel(3), network, 2, 2, acting.temperature)
    generator = stream(11, TRAINING, 2, "epsilon_rhp")
    explored = 0
    for state, action in zip(made.states, made.actions, strict=False):
        explores = generator.random() < acting.epsilon
        expected = policy.decide(state, made.instance.goals, generator).action
        if explores:
            explored += 1
            allowed = np.flatnonzero(allowed_actions(state))
            expected = generator.choice(allowed)
        assert action == expected
    assert 0 < explored < len(made.actions)


def pairs_of(search):
    """The states and actions that were simulated."""
    return {
        (state.tobytes(), int(action))
        for state, action in zip(search.states, search.actions, strict=True)
    }


def test_rhp_may_act_in_physics_that_it_does_not_know():
    network = load_q_network(models_path() / "q_network/best.safetensors", 3)
    demonstrator = RecedingHorizonDemonstrator(11, network, Acting(uncertainty="high"))
    made, again = (demonstrator.demonstrate(2) for _ in range(2))
    equal(made, again)
    search = made.search
    nominal = PushModel(3).step(search.states, search.actions)
    differs = ~np.isclose(nominal, search.next_states, atol=1e-9).all(axis=1)
    # What was executed and touched something came out otherwise; roll-outs did not.
    assert 0 < differs.sum() <= MAX_ACTIONS


def test_the_guided_search_demonstrates():
    network = load_q_network(models_path() / "q_network/best.safetensors", 3)
    made, again = (GuidedDemonstrator(11, network).demonstrate(2) for _ in range(2))
    equal(made, again)
    assert goals_reached(made.states[-1], made.instance.goals)
    assert len(made.actions) <= len(PlanningDemonstrator(11, 3).demonstrate(2).actions)
