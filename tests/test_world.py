"""Worlds of one's own: what a policy is run in."""

import numpy as np
import pytest

from rhp_drake.errors import InputError, WorkError
from rhp_drake.evaluation.episode import TIME_LIMIT, run_episode, run_episodes
from rhp_drake.evaluation.experiment import Experiment, make_columns, run_batch
from rhp_drake.evaluation.world import PlanarWorld, WorldError, load_world_factory
from rhp_drake.frozen_instances import load_instances
from rhp_drake.planning.policy import Decision
from rhp_drake.random_streams import VALIDATION
from rhp_drake.task import MAX_ACTIONS, Action, hand_targets

INSTANCE = load_instances(VALIDATION)[0]
# A user's file: the boxes of this world are glued to the table.
SOURCE = """
import numpy as np
import rhp_drake.task

class Glued:
    def __init__(self, instance, physics, seed):
        self.instance, self.physics, self.seed = instance, physics, seed
    def reset(self):
        self.state = self.instance.initial_state.copy()
    def step(self, action):
        self.state = self.state.copy()
        self.state[:3] = rhp_drake.task.hand_targets(self.state, action)
"""


class Turning:
    """A policy that turns left and right."""

    def decide(self, state, goals, generator, memory=None):
        left = memory is None or memory == Action.CLOCKWISE
        action = Action.COUNTERCLOCKWISE if left else Action.CLOCKWISE
        return Decision(int(action), -1.0, memory=action)


class Strange:
    """A world whose state after one action is the given one."""

    def __init__(self, state):
        self._after = state

    def reset(self):
        self.state = INSTANCE.initial_state

    def step(self, action):
        if isinstance(self._after, Exception):
            raise self._after
        self.state = self._after


def test_a_world_of_ones_own_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "glued_world.py").write_text(SOURCE)
    work = Experiment(
        make_columns(["gp"], ["best"]),
        ["high"],
        VALIDATION,
        3,
        num_instances=1,
        num_trials=1,
        world="glued_world:Glued",
        seed=0,
    )
    (batch,) = work.batches()
    (episode,) = run_batch(batch, work)
    assert episode.outcome == "out of actions"
    assert episode.num_actions == MAX_ACTIONS
    np.testing.assert_array_equal(episode.states[-1][3:], INSTANCE.initial_state[3:])
    world = load_world_factory("glued_world:Glued")(INSTANCE, "physics", 3)
    assert (world.instance, world.physics, world.seed) == (INSTANCE, "physics", 3)


def test_a_world_begins_anew_when_it_is_reset():
    world = PlanarWorld(lambda states, actions: states + 1.0, INSTANCE)
    world.step(0)
    assert (world.state == INSTANCE.initial_state + 1.0).all()
    world.reset()
    assert (world.state == INSTANCE.initial_state).all()


@pytest.mark.parametrize(
    "after", [WorldError("stuck"), np.full(12, np.nan)], ids=["refuses", "not finite"]
)
def test_a_world_may_fail(after):
    episode = run_episode(Strange(after), Turning(), INSTANCE, 0)
    assert episode.outcome == "world failed"
    assert episode.num_actions == 1
    assert np.isfinite(episode.states).all()


def test_a_world_of_another_shape_is_refused():
    with pytest.raises(InputError, match=r"Strange shows a state of shape \(3,\)"):
        run_episode(Strange(np.zeros(3)), Turning(), INSTANCE, 0)


def test_a_world_that_cannot_begin_says_nothing_of_the_policy():
    world = Strange(None)
    world.reset = lambda: setattr(world, "state", np.full(12, np.nan))
    with pytest.raises(WorkError, match="Strange cannot be reset: the state is not f"):
        run_episode(world, Turning(), INSTANCE, 0)


def test_computation_has_a_limit(monkeypatch):
    clock = iter(np.arange(100) * (TIME_LIMIT / 2))
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))

    def turn(states, actions):
        after = states.copy()
        after[:, :3] = hand_targets(states, actions)
        return after

    (episode,) = run_episodes(turn, Turning(), [INSTANCE])
    assert episode.outcome == "out of time"
    # Each decision and each action takes half of the limit.
    assert episode.num_actions == 2
