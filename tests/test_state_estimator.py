"""Tests of rhp_drake.systems.state_estimator."""

import math

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake.station.ur5_kinematics import inverse_kinematics
from rhp_drake.systems.state_estimator import (
    REST_ANGLE,
    REST_DISTANCE,
    REST_JOINT_SPEED,
    REST_WINDOW,
    StateEstimator,
)

HAND = np.array([0.5, 0.1, 0.4])
OBJECTS = np.array([[0.6, 0.1, 0.3], [0.4, -0.2, -3.0]])


def fix_inputs(dut, context, *, hand=HAND, objects=OBJECTS, speed=0.0, tilt=0.0):
    q = inverse_kinematics(hand)
    poses = [
        RigidTransform(RollPitchYaw(tilt, tilt, theta), [x, y, 0.03])
        for x, y, theta in objects
    ]
    dut.GetInputPort("position_measured").FixValue(context, q)
    dut.GetInputPort("velocity_estimated").FixValue(context, np.full(6, speed))
    dut.GetInputPort("object_poses").FixValue(context, AbstractValue.Make(poses))


def eval_state(dut, context):
    return dut.GetOutputPort("state").Eval(context)


class Bench:
    """A simulated estimator of a still scene; `wait` lets time pass."""

    def __init__(self):
        self.dut = StateEstimator(num_objects=2)
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        fix_inputs(self.dut, self.context)
        self.simulator.Initialize()

    def wait(self, duration, **inputs):
        if inputs:
            fix_inputs(self.dut, self.context, **inputs)
        self.simulator.AdvanceTo(self.context.get_time() + duration)
        return self.at_rest

    @property
    def at_rest(self):
        return bool(self.dut.GetOutputPort("at_rest").Eval(self.context)[0])


def test_state():
    dut = StateEstimator(num_objects=2)
    context = dut.CreateDefaultContext()
    fix_inputs(dut, context)
    np.testing.assert_allclose(
        eval_state(dut, context), [*HAND, *OBJECTS.ravel()], atol=1e-9
    )


@pytest.mark.parametrize("heading", [-5.0, -3.5, 0.0, 3.5, 5.0])
def test_hand_heading_counts_turns(heading):
    dut = StateEstimator(num_objects=2)
    context = dut.CreateDefaultContext()
    fix_inputs(dut, context, hand=[0.5, 0.0, heading])
    assert eval_state(dut, context)[2] == pytest.approx(heading)


def test_yaw_of_a_tilted_object_is_that_of_its_x_axis():
    dut = StateEstimator(num_objects=2)
    context = dut.CreateDefaultContext()
    fix_inputs(dut, context, tilt=0.2)
    assert eval_state(dut, context)[5] == pytest.approx(OBJECTS[0, 2])
    assert eval_state(dut, context)[8] == pytest.approx(OBJECTS[1, 2])


def test_number_of_poses_must_match():
    dut = StateEstimator(num_objects=2)
    context = dut.CreateDefaultContext()
    fix_inputs(dut, context, objects=OBJECTS[:1])
    with pytest.raises(ValueError, match="1 poses, not 2"):
        eval_state(dut, context)


def test_joints_not_finite_give_a_state_not_finite():
    dut = StateEstimator(num_objects=2)
    context = dut.CreateDefaultContext()
    fix_inputs(dut, context)
    dut.GetInputPort("position_measured").FixValue(context, np.full(6, math.nan))
    assert np.isnan(eval_state(dut, context)[:3]).all()


def test_at_rest_only_after_the_window():
    bench = Bench()
    assert not bench.at_rest
    assert not bench.wait(0.9 * REST_WINDOW)
    assert bench.wait(0.3 * REST_WINDOW)
    assert bench.wait(1.0)


MOVED_HAND = np.add(HAND, [1.1 * REST_DISTANCE, 0, 0])
TURNED_HAND = np.add(HAND, [0, 0, 1.1 * REST_ANGLE])
MOVED_OBJECT = np.add(OBJECTS, [[0, 0, 0], [0, 1.1 * REST_DISTANCE, 0]])
TURNED_OBJECT = np.add(OBJECTS, [[0, 0, -1.1 * REST_ANGLE], [0, 0, 0]])


@pytest.mark.parametrize(
    "inputs",
    [
        {"hand": MOVED_HAND},
        {"hand": TURNED_HAND},
        {"objects": MOVED_OBJECT},
        {"objects": TURNED_OBJECT},
    ],
)
def test_any_motion_starts_the_window_anew(inputs):
    bench = Bench()
    assert bench.wait(2 * REST_WINDOW)
    assert not bench.wait(0.2 * REST_WINDOW, **inputs)
    assert not bench.wait(0.6 * REST_WINDOW)
    assert bench.wait(0.5 * REST_WINDOW)


def test_moving_joints_are_not_at_rest():
    bench = Bench()
    assert not bench.wait(3 * REST_WINDOW, speed=1.1 * REST_JOINT_SPEED)
    assert bench.wait(1.2 * REST_WINDOW, speed=0.5 * REST_JOINT_SPEED)


def test_noise_does_not_count_as_motion():
    bench = Bench()
    generator = np.random.default_rng(0)
    bench.wait(1.3 * REST_WINDOW)
    for _ in range(30):
        noise = generator.uniform(-0.4, 0.4, size=(2, 3))
        objects = OBJECTS + noise * [REST_DISTANCE, REST_DISTANCE, REST_ANGLE]
        assert bench.wait(0.008, objects=objects)


def test_yaw_across_half_a_turn_is_no_motion():
    bench = Bench()
    bench.wait(0.1, objects=[[0.6, 0.1, math.pi - 1e-4], [0.4, 0.2, 0]])
    assert bench.wait(0.2)
    assert bench.wait(0.1, objects=[[0.6, 0.1, -math.pi + 1e-4], [0.4, 0.2, 0]])


def test_creep_is_noticed():
    bench = Bench()
    bench.wait(2 * REST_WINDOW)
    rests = [
        bench.wait(0.008, objects=np.add(OBJECTS, [[5e-5 * i, 0, 0], [0, 0, 0]]))
        for i in range(100)
    ]
    assert sum(rests) < 15


def test_a_state_not_finite_is_not_at_rest():
    bench = Bench()
    bench.wait(2 * REST_WINDOW)
    bench.dut.GetInputPort("position_measured").FixValue(
        bench.context, np.full(6, math.nan)
    )
    assert not bench.wait(2 * REST_WINDOW)
    assert bench.wait(1.5 * REST_WINDOW, hand=HAND)


def test_initialization_starts_the_window_anew():
    bench = Bench()
    assert bench.wait(2 * REST_WINDOW)
    bench.simulator.Initialize()
    assert not bench.at_rest
    assert not bench.wait(0.5 * REST_WINDOW)
