"""Predictive sampling, MPPI and chance: what plans without having learned."""

import copy

import numpy as np
import pytest

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import PolicyError
from rhp_drake.planning.policy_config import (
    POLICIES,
    GreedyConfig,
    MakePolicy,
    MppiConfig,
    PredictiveSamplingConfig,
    RandomConfig,
    RecedingHorizonConfig,
    named_policy,
)
from rhp_drake.planning.random_policy import Random
from rhp_drake.planning.sampling_mpc import Mppi, PredictiveSampling, hand_made_cost
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.scenario import load_scenario
from rhp_drake.task import (
    MAX_ACTIONS,
    NUM_ACTIONS,
    TABLE_UPPER,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    Action,
    allowed_actions,
    goals_reached,
    hand_targets,
)
from rhp_drake.typed_yaml import expand

PLANNERS = (PredictiveSampling, Mppi)
# A target in the hand's opening, which looks along x, and an obstacle at home.
STATE = np.array([0.40, 0.0, 0.0, 0.40, 0.0, 0.0, 0.30, 0.20, 0.0])
GOALS = np.array([[0.60, 0.0], [0.30, 0.20]])
OUT_OF_REACH = np.array([[2.0, 2.0], [0.30, 0.20]])


def changed(**entries) -> np.ndarray:
    """STATE with other values: hand_x and so on, by name."""
    bodies = ("hand", "target", "obstacle")
    names = [f"{body}_{part}" for body in bodies for part in ("x", "y", "angle")]
    state = STATE.copy()
    for name, value in entries.items():
        state[names.index(name)] = value
    return state


class CarryingModel:
    """A push model in which the target sticks to the hand; notes what it is asked."""

    def __init__(self):
        self.asked = []

    def step(self, states, actions):
        self.asked += zip(states, actions, strict=True)
        after = states.copy()
        after[:, :3] = hand_targets(states, actions)
        after[:, 3:5] += after[:, :2] - states[:, :2]
        return after


class RefusingModel:
    """A push model that refuses all states."""

    def step(self, states, actions):
        raise PushModelError("bodies deep inside each other.")


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        # The target on its way.
        ({"target_x": 0.45}, {}),
        # The hand on its way to a target ahead of it.
        ({"hand_x": 0.25}, {"hand_x": 0.20}),
        # The opening faces the target, and pushes it ahead rather than back.
        ({"hand_x": 0.25}, {"hand_x": 0.25, "hand_angle": 0.5}),
        ({}, {"hand_angle": np.pi}),
        # Obstacles: at home, within reach of home, farther out.
        ({}, {"obstacle_x": 0.37}),
        ({"obstacle_x": 0.37}, {"obstacle_x": 0.42}),
        ({"obstacle_x": 0.75}, {"obstacle_y": TABLE_UPPER[1] + 0.01}),
        ({"target_x": 0.85}, {"target_y": TABLE_UPPER[1] + 0.01}),
        # The goal, even if the hand is far from all.
        ({"target_x": 0.56, "hand_y": -0.3, "hand_angle": 9.0}, {"target_x": 0.53}),
    ],
)
def test_cost_prefers(better, worse):
    costs = hand_made_cost(np.array([changed(**better), changed(**worse)]), GOALS)
    assert 0 <= costs[0] < costs[1]


def test_cost_is_about_the_number_of_actions_left():
    """Nothing is left at the goal, and the target's way counts in full."""
    states = np.array([changed(target_x=x, hand_x=x) for x in (0.60, 0.49, 0.44)])
    np.testing.assert_allclose(hand_made_cost(states, GOALS), [0, 1, 2])
    assert hand_made_cost(states[:0], GOALS).shape == (0,)


@pytest.mark.parametrize("planner", PLANNERS)
def test_same_generator_same_decision(planner):
    policy = planner(CarryingModel(), 6, 6)
    first, again, other = (
        policy.decide(STATE, GOALS, stream(seed, "decision")) for seed in (1, 1, 2)
    )
    assert first.action == again.action
    np.testing.assert_array_equal(first.roll_outs, again.roll_outs)
    np.testing.assert_array_equal(first.returns, again.returns)
    np.testing.assert_array_equal(first.memory, again.memory)
    assert (first.roll_outs != other.roll_outs).any()


@pytest.mark.parametrize("planner", PLANNERS)
def test_roll_outs_and_returns(planner):
    """A return is minus the costs along the roll-out."""
    model = CarryingModel()
    decision = planner(model, 7, 3).decide(STATE, OUT_OF_REACH, stream(0))
    assert decision.roll_outs.shape == (7, 4, 9)
    assert (decision.roll_outs[:, 0] == STATE).all()
    costs = [hand_made_cost(decision.roll_outs[:, k], OUT_OF_REACH) for k in (1, 2, 3)]
    np.testing.assert_allclose(decision.returns, -np.sum(costs, axis=0))
    assert decision.returns.min() <= decision.value <= decision.returns.max()
    # Equal pairs are simulated once.
    pairs = {(state.tobytes(), int(action)) for state, action in model.asked}
    assert len(pairs) == len(model.asked) <= 7 * 3


@pytest.mark.parametrize("num_actions", [1, 2])
@pytest.mark.parametrize("planner", PLANNERS)
def test_goal_in_reach_is_reached(planner, num_actions):
    """A roll-out ends at the goal, and the earlier the better."""
    goals = GOALS.copy()
    goals[0, 0] = 0.40 + 0.05 * num_actions + 0.055
    model = CarryingModel()
    decision = planner(model, 200, 3).decide(STATE, goals, stream(0))
    assert decision.action == Action.FORWARD
    reached = goals_reached(decision.roll_outs, goals)
    best = decision.returns.argmax()
    assert list(reached[best]) == [k >= num_actions for k in range(4)]
    assert not any(goals_reached(state, goals) for state, _ in model.asked)
    ended = decision.roll_outs[best, num_actions:]
    assert (ended == ended[0]).all()


@pytest.mark.parametrize("planner", PLANNERS)
def test_roll_outs_stop_once_all_have_ended(planner):
    goals = np.array([[0.40, 0.10], [0.30, 0.20]])
    first = np.eye(NUM_ACTIONS)[[Action.LEFT, Action.LEFT]]
    decision = planner(CarryingModel(), 1, 3).decide(STATE, goals, stream(0), first)
    assert decision.action == Action.LEFT
    assert decision.roll_outs.shape == (1, 2, 9)
    assert decision.value == 0
    # What is left of the plan is less than usual.
    state = decision.roll_outs[0, -1] - [0, 0.05, 0, 0, 0.05, 0, 0, 0, 0]
    again = planner(CarryingModel(), 9, 3).decide(
        state, goals, stream(0), decision.memory
    )
    assert again.roll_outs.shape[:2] == (9, 4)


@pytest.mark.parametrize("planner", PLANNERS)
def test_goes_on_with_the_plan_of_the_last_decision(planner):
    policy = planner(CarryingModel(), 100, 4)
    memory = policy.decide(STATE, OUT_OF_REACH, stream(0)).memory
    assert memory.shape == (3, NUM_ACTIONS)
    # A single roll-out is the plan itself, moved on by one action.
    alone = planner(CarryingModel(), 1, 4)
    decisions = [
        alone.decide(STATE, OUT_OF_REACH, stream(k), copy.deepcopy(memory))
        for k in range(5)
    ]
    state = STATE[None]
    for depth, action in enumerate(memory.argmax(axis=1)):
        state = CarryingModel().step(state, np.array([action]))
        for decision in decisions:
            np.testing.assert_array_equal(decision.roll_outs[:, depth + 1], state)
    assert {d.action for d in decisions} == {memory[0].argmax()}
    # What comes after it is open.
    assert len({d.roll_outs[0, -1].tobytes() for d in decisions}) > 1


def test_predictive_sampling_mutates_its_plan():
    plan = np.eye(NUM_ACTIONS)[[Action.LEFT] * 5]
    policy = PredictiveSampling(CarryingModel(), 2000, 6)
    decision = policy.decide(STATE, GOALS, stream(0), plan)
    lefts = np.isclose(np.diff(decision.roll_outs[:, :6, 1], axis=1), 0.05)
    assert lefts[0].all()
    # Five of six random actions differ from the plan's.
    assert 0.2 < 1 - lefts[1:, 0].mean() < 0.3
    assert 1 < len(np.unique(decision.roll_outs[:, -1], axis=0)) < 2000


def test_mppi_weighs_roll_outs():
    """Frequencies of actions, but none dies out."""
    decision = Mppi(CarryingModel(), 500, 6).decide(STATE, GOALS, stream(0))
    assert decision.action == Action.FORWARD
    np.testing.assert_allclose(decision.memory.sum(axis=1), 1)
    assert decision.memory.min() > 0
    # Forward it goes: hundreds of roll-outs that do not count no longer.
    assert decision.memory[0].argmax() == Action.FORWARD
    assert decision.memory[0].max() > 0.5


@pytest.mark.parametrize("make", [*PLANNERS, None])
def test_never_beyond_the_border(make):
    """Neither simulated nor executed, even if the old plan says so."""
    model = CarryingModel()
    policy = make(model, 6, 6) if make else Random()
    corner = changed(hand_x=0.78, hand_y=0.28)  # Neither forward nor left.
    outward = np.eye(NUM_ACTIONS)[[Action.FORWARD, Action.LEFT] * 2 + [Action.FORWARD]]
    chosen = set()
    for seed in range(20):
        decision = policy.decide(corner, OUT_OF_REACH, stream(seed), outward)
        chosen.add(decision.action)
        assert allowed_actions(corner)[decision.action]
        hands = decision.roll_outs[..., :2].reshape(-1, 2)
        assert (hands <= WORKSPACE_UPPER + 0.001).all()
        assert (hands >= WORKSPACE_LOWER - 0.001).all()
    assert len(chosen) > 1
    assert all(allowed_actions(state)[action] for state, action in model.asked)


@pytest.mark.parametrize("planner", PLANNERS)
def test_the_old_plan_decides_where_the_model_refuses_the_state(planner):
    policy = planner(RefusingModel(), 6, 3)
    plan = np.eye(NUM_ACTIONS)[[Action.LEFT, Action.RIGHT]]
    decision = policy.decide(STATE, GOALS, stream(0), plan)
    assert decision.action == Action.LEFT
    assert not len(decision.roll_outs)
    again = policy.decide(STATE, GOALS, stream(0), decision.memory)
    assert again.action == Action.RIGHT
    # Without a plan, or if it is not allowed, by chance.
    corner = changed(hand_x=0.78, hand_y=0.28)
    for memory in (None, plan):
        chosen = {
            policy.decide(corner, GOALS, stream(seed), memory).action
            for seed in range(50)
        }
        assert chosen == set(np.flatnonzero(allowed_actions(corner)))


@pytest.mark.parametrize(
    "policy",
    [Random(), *(planner(CarryingModel(), 6, 6) for planner in PLANNERS)],
    ids=lambda policy: type(policy).__name__,
)
def test_nothing_to_decide(policy):
    with pytest.raises(PolicyError, match="workspace"):
        policy.decide(changed(hand_x=5.0), GOALS, stream(0))
    with pytest.raises(PolicyError, match="the state is not finite"):
        policy.decide(changed(obstacle_x=np.nan), GOALS, stream(0))


def test_random_is_uniform():
    num_draws = 1200
    counts = np.zeros(NUM_ACTIONS)
    generator = stream(0)
    for _ in range(num_draws):
        counts[Random().decide(STATE, GOALS, generator).action] += 1
    expected = num_draws / NUM_ACTIONS
    assert (np.abs(counts - expected) < 4 * np.sqrt(expected)).all()


@pytest.mark.parametrize("name", ["ps16x6", "mppi16x6"])
def test_pushes_a_box_home(name):
    """With the real push model, and an obstacle to leave alone."""
    policy, world = MakePolicy(named_policy(name), 2), PushModel(2)
    state, memory = changed(hand_x=0.30, hand_angle=0.6), None
    for k in range(MAX_ACTIONS):
        decision = policy.decide(state, GOALS, stream(0, k), memory)
        memory = decision.memory
        state = world.step(state[None], np.array([decision.action]))[0]
        if goals_reached(state, GOALS):
            break
    assert goals_reached(state, GOALS)
    assert k < 15


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("random", RandomConfig()),
        ("gp", GreedyConfig()),
        ("rhp66_rescue", RecedingHorizonConfig(rescue=True)),
        ("rhp16x8", RecedingHorizonConfig(num_roll_outs=16, horizon=8)),
        ("ps66", PredictiveSamplingConfig(num_roll_outs=6, horizon=6)),
        ("ps64x8", PredictiveSamplingConfig(num_roll_outs=64, horizon=8)),
        ("mppi66", MppiConfig(num_roll_outs=6, horizon=6)),
        ("mppi1x10", MppiConfig(num_roll_outs=1, horizon=10)),
    ],
)
def test_named(name, config):
    assert named_policy(name) == config
    named_policy(name).validate()


def test_every_short_name_is_known():
    for name, make in POLICIES.items():
        assert named_policy(name) == make()


@pytest.mark.parametrize(
    "name", ["", "rhp", "ps", "ps64", "ps0x6", "mppi6x0", "ps-1x6", "gp6x6", "ps6x6 "]
)
def test_names_of_nothing(name):
    with pytest.raises(InputError, match=r"is no policy; there are kdp, .*\.$") as info:
        named_policy(name)
    assert str(info.value).startswith(repr(name))


@pytest.mark.parametrize("make", [PredictiveSamplingConfig, MppiConfig])
@pytest.mark.parametrize("key", ["num_roll_outs", "horizon"])
def test_impossible_values(make, key):
    with pytest.raises(
        InputError, match=rf"^policy\.{key} is 0; it must be at least 1\.$"
    ):
        make(**{key: 0}).validate()


@pytest.mark.parametrize(
    "config", [RandomConfig(), PredictiveSamplingConfig(horizon=3), MppiConfig()]
)
def test_scenarios_can_name_it(config):
    name = type(config).__name__
    values = expand(config)
    text = f"policy: !{name} {values}".replace("'", '"')
    _, scenario = load_scenario("three_boxes", overrides=[text])
    assert scenario.policy == config
    assert expand(scenario)["policy"] == values | {"_tag": f"!{name}"}
