"""The station as a world: actions there, one by one, in three dimensions."""

import numpy as np
import pytest

from rhp_drake.evaluation import station_world
from rhp_drake.evaluation.episode import run_episode
from rhp_drake.evaluation.model_gap import compare_pushes
from rhp_drake.evaluation.station_world import MakeStationSimulator, StationWorld
from rhp_drake.evaluation.world import WorldError
from rhp_drake.frozen_instances import load_instances
from rhp_drake.physics import draw_physics, nominal_physics
from rhp_drake.planning.policy import Decision
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.task import Action, TaskInstance, hand_targets, object_positions

INSTANCE = load_instances(VALIDATION)[0]
# A box in front of the palm, out of the others' way.
STATE = np.array([0.35, 0.0, 0.0, 0.42, 0.0, 0.1, 0.6, 0.25, 0.0, 0.6, -0.25, 0.5])


@pytest.fixture(scope="module")
def simulator():
    return MakeStationSimulator()


def make(simulator, state=STATE, level="none"):
    goals = object_positions(state).copy()
    goals[0] = [0.75, 0.0]
    physics = draw_physics(level, state, stream(0, "test_station_world"))
    return StationWorld(simulator, TaskInstance(state, goals), physics)


def test_it_begins_where_the_task_does(simulator):
    world = StationWorld(simulator, INSTANCE, nominal_physics(3))
    world.reset()
    np.testing.assert_allclose(world.state, INSTANCE.initial_state, atol=2e-3)
    assert 0 < world.simulated_seconds < 0.5


def test_actions_move_the_hand_and_what_is_before_it(simulator):
    world = make(simulator)
    world.reset()
    for action in (Action.FORWARD, Action.FORWARD, Action.COUNTERCLOCKWISE):
        before = world.state
        world.step(action)
        expected = hand_targets(before, np.array(action))
        np.testing.assert_allclose(world.state[:3], expected, atol=0.02)
    moved = object_positions(world.state) - object_positions(STATE)
    assert moved[0, 0] > 0.015
    np.testing.assert_allclose(moved[1:], 0, atol=1e-3)


@pytest.mark.parametrize("level", ["none", "high"])
def test_the_same_actions_lead_to_the_same_state(level, simulator):
    ends = []
    for _ in range(2):
        world = make(simulator, level=level)
        world.reset()
        world.step(Action.FORWARD)
        ends.append(world.state)
        # Whoever uses the simulator in between leaves no trace.
        StationWorld(simulator, INSTANCE, nominal_physics(3)).reset()
    np.testing.assert_array_equal(*ends)


def test_an_arm_that_is_stopped_is_an_error(simulator, monkeypatch):
    world = make(simulator)
    world.reset()
    # Out of the hand's workspace, but within the arm's reach.
    monkeypatch.setattr(
        station_world, "hand_targets", lambda state, action: np.array([0.55, 0.4, 0.0])
    )
    with pytest.raises(WorldError, match="the arm was stopped: a command takes the ha"):
        world.step(Action.FORWARD)


def test_an_action_that_is_never_done_is_an_error(simulator, monkeypatch):
    world = make(simulator)
    world.reset()
    monkeypatch.setattr(station_world, "PATIENCE", 0.2)
    with pytest.raises(WorldError, match=r"the action is not done after 0\.2 s"):
        world.step(Action.FORWARD)


def test_an_episode_in_the_station_takes_simulated_time(simulator):
    class Forward:
        def decide(self, state, goals, generator, memory=None):
            return Decision(int(Action.FORWARD), np.nan)

    state = STATE.copy()
    goals = object_positions(state).copy()
    goals[0] = [0.51, 0.0]
    instance = TaskInstance(state, goals)
    world = StationWorld(simulator, instance, nominal_physics(3))
    episode = run_episode(world, Forward(), instance, 0)
    assert episode.succeeded
    assert episode.simulated_seconds > 0.7 * episode.num_actions
    assert len(episode.states) == episode.num_actions + 1


def test_pushes_in_both_worlds_go_alike():
    pushes = list(compare_pushes(3, seed=0))
    assert len(pushes) == 3
    errors = np.concatenate([push.displacement_errors() for push in pushes])
    moved = np.concatenate([push.displacements() for push in pushes])
    assert errors.mean() < 0.3 * moved.mean()
