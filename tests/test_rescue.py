"""A policy that goes in circles is got out of them by a plan."""

import numpy as np
import pytest

from rhp_drake.evaluation.episode import run_episodes
from rhp_drake.planning.policy import Decision
from rhp_drake.planning.policy_config import POLICIES, MakePolicy
from rhp_drake.planning.rescue import Rescued
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.task import Action, TaskInstance

# Three pushes forward bring the target home; the obstacles are far away.
START = np.array([0.35, 0, 0, 0.45, 0, 0, 0.3, 0.2, 0, 0.3, -0.2, 0])
GOALS = np.array([[0.59, 0.0], [0.3, 0.2], [0.3, -0.2]])


class Undecided:
    """Goes forth and back; its memory counts its decisions."""

    def __init__(self):
        self.memories = []

    def decide(self, state, goals, generator, memory=None):
        self.memories.append(memory)
        count = memory or 0
        action = Action.BACKWARD if count % 2 == 0 else Action.FORWARD
        return Decision(action, -1.0, memory=count + 1)


class Distance:
    """Values by how far the target would be from its goal, had it gone along."""

    def values(self, states, goals):
        ways = np.linalg.norm(states[:, 3:5] - goals[0], axis=-1) / 0.05
        q = np.repeat(-ways[:, None], 6, axis=1) - 1
        q[:, Action.FORWARD] += 1
        return q


@pytest.fixture(scope="module")
def push_model():
    return PushModel(3)


def test_a_plan_takes_over_in_a_state_seen_before(push_model):
    undecided = Undecided()
    policy = Rescued(undecided, push_model, Distance())
    instance = TaskInstance(START, GOALS)
    (episode,) = run_episodes(push_model.step, policy, [instance])
    assert episode.succeeded
    # Back, forth, and the third decision is made where the first one was.
    assert undecided.memories == [None, 1]
    assert episode.num_actions < 12


def test_the_policy_goes_on_where_the_plan_does_not_hold(push_model):
    undecided = Undecided()
    policy = Rescued(undecided, push_model, Distance())
    state, memory = START, None
    for _ in range(3):
        decision = policy.decide(state, GOALS, stream(0), memory)
        state = push_model.step(state[None], np.array([decision.action]))[0]
        memory = decision.memory
    assert len(undecided.memories) == 2
    # Somebody moves an obstacle: this state is new, and the plan was not made for it.
    state = state.copy()
    state[6] += 0.02
    policy.decide(state, GOALS, stream(0), memory)
    assert undecided.memories == [None, 1, None]


def test_memory_is_not_shared_between_episodes(push_model):
    policy = Rescued(Undecided(), push_model, Distance())
    first = policy.decide(START, GOALS, stream(0))
    again = policy.decide(START, GOALS, stream(0))
    assert first.action == again.action == Action.BACKWARD


@pytest.mark.parametrize("name", ["gp_rescue", "rhp33_rescue", "rhp66_rescue"])
def test_rescue_is_a_policy_by_name(name):
    assert isinstance(MakePolicy(POLICIES[name](), 3), Rescued)
    assert not isinstance(MakePolicy(POLICIES[name.split("_")[0]](), 3), Rescued)
