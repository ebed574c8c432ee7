"""A checked plan is kept while the world agrees with it, and made anew if not."""

import copy

import numpy as np
import pytest

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.planning.checked_plan import CheckedPlan
from rhp_drake.planning.kinodynamic_rrt import plan
from rhp_drake.planning.plan_rest import deviation
from rhp_drake.planning.policy import PolicyError
from rhp_drake.planning.policy_config import POLICIES, CheckedPlanConfig, MakePolicy
from rhp_drake.planning.search import Plan, SearchRecord
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream

GOALS = np.array([[0.6, 0.0], [0.3, 0.2], [0.3, -0.2]])
START = np.array([0.35, 0, 0, 0.42, 0, 0, 0.3, 0.2, 0, 0.3, -0.2, 0])


class FakePlanner:
    """Plans to go forward `length` times, and takes everything along."""

    def __init__(self, length=3):
        self.length = length
        self.starts = []

    def __call__(self, push_model, state, goals, generator, *, time_limit):
        self.starts.append(state)
        search = SearchRecord(len(state)).search()
        if self.length is None:
            return Plan(None, state[None], search, time_limit, np.nan)
        states = np.repeat(state[None], self.length + 1, axis=0)
        states[:, 0] += task.TRANSLATION * np.arange(self.length + 1)
        states[:, 3] += task.TRANSLATION * np.arange(self.length + 1)
        return Plan(np.zeros(self.length, int), states, search, 0.1, 0.1)


def run(planner, disturbances):
    """Decides at each of the planned states plus a disturbance; the decisions."""
    policy = CheckedPlan(None, 7.0, planner=planner)
    decisions, state, memory = [], START, None
    for disturbance in disturbances:
        state = state + disturbance
        decision = policy.decide(state, GOALS, stream(0), copy.deepcopy(memory))
        decisions.append(decision)
        memory = decision.memory
        state = memory.states[0].copy()
    return decisions


def shift(**entries) -> np.ndarray:
    """A change of a state: hand_x and so on, by name."""
    names = ("hand_x", "hand_y", "hand_angle", "target_x", "target_y", "target_angle")
    change = np.zeros(len(START))
    for name, value in entries.items():
        change[names.index(name)] = value
    return change


def test_follows_its_plan_while_the_world_agrees():
    planner = FakePlanner()
    small = shift(hand_x=0.003, hand_angle=-0.02, target_y=0.009, target_angle=1.0)
    decisions = run(planner, [0, small, -small])
    assert len(planner.starts) == 1
    assert [d.value for d in decisions] == [-3, -2, -1]
    assert [d.roll_outs.shape for d in decisions] == [(1, n, 12) for n in (4, 3, 2)]


@pytest.mark.parametrize(
    "change",
    [
        shift(target_x=0.011),
        shift(target_x=0.008, target_y=-0.008),
        shift(hand_y=0.011),
        shift(hand_angle=0.13),
        0.011 * np.eye(12)[10],  # The last obstacle.
    ],
)
def test_plans_anew_when_the_world_does_not(change):
    planner = FakePlanner()
    decisions = run(planner, [0, change, 0])
    assert len(planner.starts) == 2
    expected = START + task.TRANSLATION * (np.eye(12)[0] + np.eye(12)[3]) + change
    np.testing.assert_allclose(planner.starts[1], expected)
    assert [d.value for d in decisions] == [-3, -3, -2]


def test_plans_anew_at_the_end_and_at_the_border():
    planner = FakePlanner(length=1)
    assert [d.value for d in run(planner, [0, 0, 0])] == [-1, -1, -1]
    assert len(planner.starts) == 3
    # 2 mm too far on, the next step would leave the workspace.
    planner = FakePlanner(length=2)
    start = shift(hand_x=task.WORKSPACE_UPPER[0] - 2 * task.TRANSLATION - START[0])
    run(planner, [start, shift(hand_x=0.002)])
    assert len(planner.starts) == 2


def test_no_plan():
    planner = FakePlanner(length=None)
    with pytest.raises(PolicyError, match=r"^the planner found no plan in 7 s\.$"):
        run(planner, [0])
    planner.length = 3
    policy = CheckedPlan(None, 7.0, planner=planner)
    memory = policy.decide(START, GOALS, stream(0)).memory
    planner.length = None
    with pytest.raises(PolicyError, match=r"not as the plan expects it, and the pl"):
        policy.decide(START, GOALS, stream(0), memory)
    planner.length = 0
    with pytest.raises(PolicyError, match="at their goals already"):
        policy.decide(START, GOALS, stream(0))


def test_deviation_is_of_the_body_farthest_off():
    assert deviation(START, START) == 0
    change = shift(hand_x=0.003, hand_y=0.004, hand_angle=0.05, target_y=-0.002)
    assert deviation(START + change, START) == pytest.approx(0.005)
    change = shift(hand_x=0.003, hand_angle=-0.1)
    assert deviation(START + change, START) == pytest.approx(0.008)
    # The wrist counts turns.
    assert deviation(START + shift(hand_angle=2 * np.pi), START) > 0.1


def test_reaches_the_goal_in_a_world_of_short_steps():
    """With the real planner: hand and target always stop 1.5 cm short."""
    push_model = PushModel(3)
    starts = []

    def planner(push_model, state, *arguments, **limits):
        starts.append(state)
        return plan(push_model, state, *arguments, **limits)

    policy = CheckedPlan(push_model, planner=planner)
    state, memory = START, None
    for k in range(task.MAX_ACTIONS):
        decision = policy.decide(state, GOALS, stream(4, k), memory)
        memory = decision.memory
        after = push_model.step(state[None], np.array([decision.action]))[0]
        way = after[3:5] - state[3:5]
        if (moved := np.linalg.norm(way)) > 0.02:
            after[:5] -= 0.015 / moved * np.r_[way, 0, way]
        state = after
        if task.goals_reached(state, GOALS):
            break
    assert task.goals_reached(state, GOALS)
    assert 2 <= len(starts) <= k


def test_made_from_its_config():
    config = POLICIES["kdp_checked"]()
    config.tolerance = 0.02
    planner = FakePlanner()
    policy = MakePolicy(config, 3, planner=planner)
    memory = policy.decide(START, GOALS, stream(0)).memory
    for off, num_plans in ((0.019, 1), (0.021, 2)):
        policy.decide(memory.states[0] + shift(target_x=off), GOALS, stream(0), memory)
        assert len(planner.starts) == num_plans


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"tolerance": -0.1}, "tolerance is -0.1; it must be at least 0 and finite."),
        ({"time_limit": 0}, "time_limit is 0; it must be above 0 and finite."),
    ],
)
def test_impossible_config(values, message):
    with pytest.raises(InputError, match=message):
        CheckedPlanConfig(**values).validate()
