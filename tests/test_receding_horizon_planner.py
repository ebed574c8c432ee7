"""Tests of rhp_drake.systems.receding_horizon_planner."""

import math

import numpy as np
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake.errors import InputError
from rhp_drake.planning.policy import Decision, PolicyError
from rhp_drake.random_streams import stream
from rhp_drake.systems.receding_horizon_planner import (
    ARRIVAL_DISTANCE,
    MAX_SEED,
    PATIENCE,
    PLANNER_PERIOD,
    RecedingHorizonPlanner,
    Status,
)
from rhp_drake.task import MAX_ACTIONS, Action, allowed_actions, hand_targets

HAND = np.array([0.5, 0.0, 0.2])
OBJECTS = np.array([0.6, 0.1, 0.0, 0.4, -0.2, 0.0])
STATE = np.concatenate([HAND, OBJECTS])
GOALS = np.array([[0.7, 0.2], [0.4, -0.2]])
SOLVED = np.concatenate([HAND, [0.7, 0.17, 0.0], OBJECTS[3:]])


class Script:
    """A policy with its actions written down; counts in its memory."""

    def __init__(self, *actions):
        self._actions = actions

    def decide(self, state, goals, generator, memory=None):
        index = 0 if memory is None else memory
        if index == len(self._actions):
            raise PolicyError("the script is at its end.")
        return Decision(self._actions[index], value=-1.0, memory=index + 1)


class Dice:
    """A policy that draws any allowed action."""

    def decide(self, state, goals, generator, memory=None):
        actions = np.flatnonzero(allowed_actions(state))
        return Decision(int(generator.choice(actions)), generator.uniform())


class Bench:
    """A planner in a simulator, one period at a time."""

    def __init__(self, policy, seed=0, state=STATE):
        self.dut = RecedingHorizonPlanner(policy, num_objects=2)
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        self.dut.set_seed(self.context, seed)
        self.dut.GetInputPort("goals").FixValue(self.context, GOALS.ravel())
        self.give(state, at_rest=True)
        self.simulator.Initialize()
        self.ticks = 0

    def give(self, state, at_rest):
        self.dut.GetInputPort("state").FixValue(self.context, state)
        self.dut.GetInputPort("at_rest").FixValue(self.context, [float(at_rest)])

    def tick(self, state, at_rest=True):
        """Gives the inputs and lets the planner look at them once."""
        self.give(state, at_rest)
        self.ticks += 1
        self.simulator.AdvanceTo((self.ticks - 0.5) * PLANNER_PERIOD)
        return self.status

    def act(self, state):
        """The planner decides, and at the next tick, nothing having moved, acts."""
        self.tick(state)
        return self.tick(state)

    def run(self, actions=1000):
        """A hand that is at its target at once; the decisions until the end."""
        records = []
        for _ in range(actions):
            self.act(np.concatenate([self.hand_target, OBJECTS]))
            if self.status != Status.RUNNING:
                break
            records.append(self.decision)
        return records

    def _eval(self, port):
        return self.dut.GetOutputPort(port).Eval(self.context)

    @property
    def hand_target(self):
        return self._eval("hand_target").copy()

    @property
    def decision(self):
        return self._eval("decision")

    @property
    def status(self):
        return Status(int(self._eval("status")[0]))

    @property
    def message(self):
        return self._eval("message")


def test_before_the_first_decision():
    bench = Bench(Script())
    np.testing.assert_array_equal(bench.hand_target, HAND)
    assert bench.decision.index == -1
    assert bench.status == Status.RUNNING
    assert bench.message == ""


def test_decides_and_records():
    bench = Bench(Script(Action.LEFT, Action.CLOCKWISE))
    bench.tick(STATE, at_rest=False)
    bench.act(STATE)
    target = hand_targets(STATE, np.array(Action.LEFT))
    np.testing.assert_array_equal(bench.hand_target, target)
    record = bench.decision
    assert (record.index, record.decision.action) == (0, Action.LEFT)
    assert record.time == pytest.approx(PLANNER_PERIOD)
    assert record.milliseconds >= 0
    assert record.target_distance == pytest.approx(math.hypot(0.1, 0.1))
    np.testing.assert_array_equal(record.state, STATE)

    # The hand arrived, not quite: the next action starts from where it is.
    arrived = np.concatenate([np.add(target, [0.001, 0.0, 0.001]), OBJECTS])
    bench.act(arrived)
    np.testing.assert_array_equal(
        bench.hand_target, hand_targets(arrived, np.array(Action.CLOCKWISE))
    )
    assert bench.decision.index == 1
    assert bench.decision.decision.memory == 2
    # What was handed out before is as it was.
    assert record.index == 0
    np.testing.assert_array_equal(record.state, STATE)


def test_waits_for_the_hand_and_for_rest():
    bench = Bench(Script(Action.FORWARD, Action.FORWARD))
    bench.act(STATE)
    target = bench.hand_target
    there = np.concatenate([target, OBJECTS])
    nearly = there + np.eye(9)[0] * 1.1 * ARRIVAL_DISTANCE
    for state, at_rest in ((STATE, True), (nearly, True), (there, False)):
        assert bench.tick(state, at_rest) == Status.RUNNING
        assert bench.decision.index == 0
        np.testing.assert_array_equal(bench.hand_target, target)
    bench.act(there)
    assert bench.decision.index == 1


def test_decides_anew_where_the_scene_changed_while_the_policy_thought():
    bench = Bench(Script(Action.FORWARD))
    bench.tick(STATE)
    moved, turned = STATE.copy(), STATE.copy()
    moved[3] += 0.003
    turned[8] += 0.03
    for state in (moved, turned, STATE):
        bench.tick(state)
        assert bench.decision.index == -1
        np.testing.assert_array_equal(bench.hand_target, HAND)
    # In motion, too, what was thought is forgotten.
    bench.tick(STATE, at_rest=False)
    bench.tick(STATE)
    assert bench.decision.index == -1
    almost = STATE + 0.001
    bench.tick(almost)
    assert bench.decision.index == 0
    np.testing.assert_array_equal(bench.decision.state, STATE)
    np.testing.assert_array_equal(
        bench.hand_target, hand_targets(almost, np.array(Action.FORWARD))
    )


def test_success_ends_the_episode():
    bench = Bench(Script(Action.LEFT, Action.RIGHT))
    assert bench.act(STATE) == Status.RUNNING
    target = bench.hand_target
    solved = np.concatenate([target, SOLVED[3:]])
    assert bench.tick(solved, at_rest=False) == Status.RUNNING
    assert bench.tick(solved) == Status.SUCCEEDED
    assert "goals" in bench.message
    # Whatever happens then.
    assert bench.tick(np.full(9, math.nan)) == Status.SUCCEEDED
    np.testing.assert_array_equal(bench.hand_target, target)
    assert bench.decision.index == 0


def test_out_of_actions():
    turns = [Action.COUNTERCLOCKWISE, Action.CLOCKWISE] * MAX_ACTIONS
    bench = Bench(Script(*turns))
    assert len(bench.run()) == MAX_ACTIONS
    assert bench.status == Status.OUT_OF_ACTIONS
    assert str(MAX_ACTIONS) in bench.message


def test_success_with_the_last_action_counts():
    turns = [Action.COUNTERCLOCKWISE, Action.CLOCKWISE] * MAX_ACTIONS
    bench = Bench(Script(*turns))
    assert len(bench.run(actions=MAX_ACTIONS)) == MAX_ACTIONS
    solved = np.concatenate([bench.hand_target, SOLVED[3:]])
    assert bench.tick(solved) == Status.SUCCEEDED


def test_fallen_object_is_noticed_in_motion():
    bench = Bench(Script(Action.FORWARD))
    bench.tick(STATE)
    fallen = STATE.copy()
    fallen[6] = 0.05
    assert bench.tick(fallen, at_rest=False) == Status.OBJECT_FELL
    assert "fell" in bench.message


def test_policy_failure():
    bench = Bench(Script(Action.FORWARD))
    assert len(bench.run()) == 1
    assert bench.status == Status.POLICY_FAILED
    assert bench.message == "the script is at its end."


def test_action_out_of_the_workspace_is_refused():
    state = np.concatenate([[0.79, 0.0, 0.0], OBJECTS])
    bench = Bench(Script(Action.FORWARD), state=state)
    assert bench.tick(state) == Status.POLICY_FAILED
    assert "FORWARD" in bench.message
    np.testing.assert_array_equal(bench.hand_target, state[:3])


def test_state_not_finite():
    bench = Bench(Script(Action.FORWARD))
    bench.act(STATE)
    target = bench.hand_target
    bad = STATE.copy()
    bad[7] = math.nan
    assert bench.tick(bad, at_rest=False) == Status.POLICY_FAILED
    assert "not finite" in bench.message
    np.testing.assert_array_equal(bench.hand_target, target)


def test_hand_does_not_arrive():
    bench = Bench(Script(Action.FORWARD))
    patience = round(PATIENCE / PLANNER_PERIOD)
    bench.act(STATE)
    for _ in range(patience - 1):
        assert bench.tick(STATE) == Status.RUNNING
    bench.tick(STATE)
    assert bench.tick(STATE) == Status.TIMED_OUT
    assert "50.0 mm" in bench.message


def test_objects_do_not_come_to_rest():
    bench = Bench(Script(Action.FORWARD))
    for _ in range(round(PATIENCE / PLANNER_PERIOD) + 2):
        bench.tick(STATE, at_rest=False)
    assert bench.status == Status.TIMED_OUT
    assert "rest" in bench.message


def test_same_seed_same_decisions():
    first, again, other = (
        [r.decision.action for r in Bench(Dice(), seed).run()] for seed in (3, 3, 4)
    )
    assert len(first) == MAX_ACTIONS
    assert first == again
    assert first != other


def test_each_decision_has_its_own_stream():
    for record in Bench(Dice(), seed=MAX_SEED).run(actions=3):
        generator = stream(MAX_SEED, "decision", record.index)
        expected = Dice().decide(record.state, GOALS, generator)
        assert record.decision.action == expected.action
        assert record.decision.value == expected.value


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1])
def test_bad_seed(seed):
    dut = RecedingHorizonPlanner(Dice(), num_objects=2)
    with pytest.raises(InputError, match="seed"):
        dut.set_seed(dut.CreateDefaultContext(), seed)


def test_contexts_do_not_share_episodes():
    bench = Bench(Script(Action.LEFT, Action.RIGHT))
    fresh = bench.context.Clone()
    bench.run()
    assert bench.status == Status.POLICY_FAILED
    assert bench.dut.GetOutputPort("decision").Eval(fresh).index == -1
    assert bench.dut.GetOutputPort("status").Eval(fresh)[0] == Status.RUNNING


def test_initialization_starts_a_new_episode():
    bench = Bench(Dice(), seed=5)
    first = [r.decision.action for r in bench.run()]
    assert bench.status == Status.OUT_OF_ACTIONS
    bench.context.SetTime(0.0)
    bench.ticks = 0
    bench.give(STATE, at_rest=True)
    bench.simulator.Initialize()
    assert bench.status == Status.RUNNING
    assert bench.decision.index == -1
    np.testing.assert_array_equal(bench.hand_target, HAND)
    # The seed stays.
    assert [r.decision.action for r in bench.run()] == first
