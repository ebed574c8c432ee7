"""Tests of rhp_drake.systems.hand_servo."""

from contextlib import nullcontext
import math

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
    DiscreteTimeDelay,
)
import pytest

from rhp_drake.errors import InputError
from rhp_drake.safety import Fault
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import (
    PUSHING_HEIGHT,
    forward_kinematics,
    hand_pose,
    inverse_kinematics,
)
from rhp_drake.systems import hand_servo
from rhp_drake.systems.command_guard import CommandGuard, CommandGuardConfig
from rhp_drake.systems.hand_servo import (
    ANGULAR_SPEED,
    JOINT_SPEED,
    LINEAR_SPEED,
    HandServo,
)
from rhp_drake.task import NUM_ACTIONS, hand_targets

START = np.array([0.5, 0.05, 0.3])


class Bench:
    """A simulated servo, one tick at a time."""

    def __init__(self, start=START, height=PUSHING_HEIGHT):
        self.servo = HandServo()
        self.simulator = Simulator(self.servo)
        self.context = self.simulator.get_mutable_context()
        self.ticks = 0
        self.set_target(start)
        self.servo.GetInputPort("position_measured").FixValue(
            self.context, inverse_kinematics(start, height)
        )
        self.simulator.Initialize()

    def set_target(self, target):
        self.servo.GetInputPort("hand_target").FixValue(self.context, target)

    def run(self, duration):
        """The commands of each tick, the present one first, shape (n + 1, 6)."""
        commands = [self.position]
        for _ in range(round(duration / COMMAND_PERIOD)):
            self.ticks += 1
            self.simulator.AdvanceTo((self.ticks - 0.5) * COMMAND_PERIOD)
            commands.append(self.position)
        return np.array(commands)

    @property
    def position(self):
        return self.servo.GetOutputPort("position").Eval(self.context)


def poses_of(commands):
    return np.array([hand_pose(q) for q in commands])


def speeds_of(poses):
    """Peak speeds of H, m/s, and of its heading, rad/s."""
    velocities = np.diff(poses, axis=0) / COMMAND_PERIOD
    return np.hypot(*velocities[:, :2].T).max(), np.abs(velocities[:, 2]).max()


def test_holds_measured_position_at_start():
    bench = Bench()
    np.testing.assert_allclose(bench.run(0.1), bench.run(0.1), atol=1e-9)
    np.testing.assert_allclose(bench.position, inverse_kinematics(START), atol=1e-9)


def test_is_nan_before_initialization():
    servo = HandServo()
    context = servo.CreateDefaultContext()
    assert np.isnan(servo.GetOutputPort("position").Eval(context)).all()


@pytest.mark.parametrize("action", range(NUM_ACTIONS))
def test_action(action):
    bench = Bench()
    target = hand_targets(START, np.array(action))
    bench.set_target(target)
    commands = bench.run(2.0)
    poses = poses_of(commands)
    np.testing.assert_allclose(poses[0], START, atol=1e-9)
    np.testing.assert_allclose(poses[-1], target, atol=1e-9)
    # A straight line: position and heading make the same progress.
    progress = (poses - START) @ (target - START) / np.sum((target - START) ** 2)
    line = START + np.outer(progress, target - START)
    np.testing.assert_allclose(poses, line, atol=1e-9)
    assert (np.diff(progress) >= -1e-12).all()
    # Level and upright.
    X_WH = np.array([forward_kinematics(q) for q in commands])
    np.testing.assert_allclose(X_WH[:, 2, 3], PUSHING_HEIGHT, atol=1e-9)
    np.testing.assert_allclose(X_WH[:, 2, 2], 1, atol=1e-9)
    # As fast as allowed, no faster.
    linear, angular = speeds_of(poses)
    assert linear <= LINEAR_SPEED
    assert angular <= ANGULAR_SPEED
    assert max(linear / LINEAR_SPEED, angular / ANGULAR_SPEED) > 0.95
    # Smooth: no acceleration above the profile's peak, 5.77 d / T^2.
    acceleration = np.diff(poses, 2, axis=0) / COMMAND_PERIOD**2
    assert np.abs(acceleration[:, :2]).max() < 0.6
    assert np.abs(acceleration[:, 2]).max() < 1.2


def test_heading_turns_beyond_half_a_turn():
    bench = Bench(start=np.array([0.5, 0.0, 3.0]))
    bench.set_target(np.array([0.5, 0.0, 4.5]))
    np.testing.assert_allclose(
        hand_pose(bench.run(6.0)[-1]), [0.5, 0.0, 4.5], atol=1e-9
    )


@pytest.mark.parametrize("new_target", [[0.5, 0.15, 0.3], [0.4, 0.05, 0.0], START])
@pytest.mark.parametrize("when", [0.1, 0.4, 0.7])
def test_new_target_in_mid_motion(new_target, when):
    bench = Bench()
    bench.set_target(np.add(START, [0.05, 0.0, 0.1]))
    before = bench.run(when)
    bench.set_target(np.array(new_target))
    commands = np.concatenate([before, bench.run(4.0)[1:]])
    poses = poses_of(commands)
    np.testing.assert_allclose(poses[-1], new_target, atol=1e-9)
    linear, angular = speeds_of(poses)
    assert linear <= LINEAR_SPEED
    assert angular <= ANGULAR_SPEED
    # Nor does the velocity jump: braking takes about 2 m/s^2.
    acceleration = np.diff(poses, 2, axis=0) / COMMAND_PERIOD**2
    assert np.abs(acceleration[:, :2]).max() < 3.0
    assert np.abs(acceleration[:, 2]).max() < 15.0


def test_joints_slow_the_hand_down_on_its_path(monkeypatch):
    # At the usual speeds no joint comes near its limit in the workspace.
    monkeypatch.setattr(hand_servo, "JOINT_SPEED", 0.1)
    bench = Bench()
    target = np.add(START, [0.05, 0.03, 0.2])
    bench.set_target(target)
    commands = bench.run(6.0)
    assert np.abs(np.diff(commands, axis=0)).max() <= 0.1 * COMMAND_PERIOD + 1e-12
    poses = poses_of(commands)
    progress = (poses - START)[:, 0] / 0.05
    np.testing.assert_allclose(
        poses, START + np.outer(progress, target - START), atol=1e-9
    )
    np.testing.assert_allclose(poses[-1], target, atol=1e-9)


@pytest.mark.parametrize(
    "bad", [[math.nan, 0, 0], [0.5, 0.0, math.inf], [1.2, 0, 0], [0.5, 0, 9.0]]
)
def test_holds_when_there_is_no_way_on(bad):
    bench = Bench()
    bench.set_target(np.array(bad))
    commands = bench.run(0.2)
    np.testing.assert_array_equal(commands, np.broadcast_to(commands[0], (26, 6)))
    # And goes on when there is.
    target = np.add(START, [0.02, 0, 0])
    bench.set_target(target)
    np.testing.assert_allclose(hand_pose(bench.run(1.0)[-1]), target, atol=1e-9)


def test_holds_in_mid_motion():
    bench = Bench()
    bench.set_target(np.add(START, [0.05, 0, 0]))
    held = bench.run(0.4)[-1]
    bench.set_target(np.full(3, math.nan))
    np.testing.assert_array_equal(bench.run(0.1)[1:], np.broadcast_to(held, (12, 6)))
    bench.set_target(np.add(START, [0.05, 0, 0]))
    poses = poses_of(bench.run(1.0))
    assert speeds_of(poses)[0] <= LINEAR_SPEED
    np.testing.assert_allclose(poses[-1], np.add(START, [0.05, 0, 0]), atol=1e-9)


def test_does_not_jump_to_the_pushing_height():
    bench = Bench(height=0.05)
    bench.set_target(np.add(START, [0.05, 0, 0]))
    commands = bench.run(0.2)
    np.testing.assert_array_equal(commands, np.broadcast_to(commands[0], (26, 6)))


def test_corrects_a_small_deviation_in_height():
    bench = Bench(height=PUSHING_HEIGHT + 0.001)
    commands = bench.run(0.1)
    assert np.abs(np.diff(commands, axis=0)).max() <= JOINT_SPEED * COMMAND_PERIOD
    assert forward_kinematics(commands[-1])[2, 3] == pytest.approx(PUSHING_HEIGHT)


def test_refuses_to_start_without_a_position():
    servo = HandServo()
    simulator = Simulator(servo)
    context = simulator.get_mutable_context()
    servo.GetInputPort("hand_target").FixValue(context, START)
    servo.GetInputPort("position_measured").FixValue(context, np.full(6, math.nan))
    with pytest.raises(RuntimeError, match="not finite"):
        simulator.Initialize()


def test_initialization_latches_anew():
    bench = Bench()
    bench.set_target(np.add(START, [0.05, 0, 0]))
    bench.run(0.4)
    elsewhere = np.array([0.4, -0.2, -1.0])
    bench.set_target(elsewhere)
    q = inverse_kinematics(elsewhere)
    bench.servo.GetInputPort("position_measured").FixValue(bench.context, q)
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.position, q)
    np.testing.assert_allclose(bench.run(0.3)[-1], q, atol=1e-9)


class ServoAndGuard:
    """Servo and guard with a robot that reaches each command one period later."""

    def __init__(self):
        builder = DiagramBuilder()
        self.target = builder.AddSystem(ConstantVectorSource(np.zeros(3)))
        servo = builder.AddSystem(HandServo())
        self.guard = builder.AddSystem(CommandGuard(CommandGuardConfig(), 1))
        poses = AbstractValue.Make([RigidTransform([0.5, 0.0, 0.03])])
        source = builder.AddSystem(ConstantValueSource(poses))
        builder.Connect(
            source.get_output_port(), self.guard.GetInputPort("object_poses")
        )
        for name in ("arm_age", "arm_fault", "object_ages"):
            zero = builder.AddSystem(ConstantVectorSource(np.zeros(1)))
            builder.Connect(zero.get_output_port(), self.guard.GetInputPort(name))
        self.robot = builder.AddSystem(DiscreteTimeDelay(COMMAND_PERIOD, 1, 6))
        builder.Connect(
            self.target.get_output_port(), servo.GetInputPort("hand_target")
        )
        builder.Connect(
            servo.GetOutputPort("position"), self.guard.GetInputPort("position")
        )
        builder.Connect(
            self.guard.GetOutputPort("position"), self.robot.get_input_port()
        )
        for system in (servo, self.guard):
            builder.Connect(
                self.robot.get_output_port(), system.GetInputPort("position_measured")
            )
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)

    def context_of(self, system):
        return system.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())

    def reset(self, pose):
        context = self.simulator.get_mutable_context()
        context.SetTime(0.0)
        self.diagram.SetDefaultContext(context)
        # Its state is the last input and the output.
        self.context_of(self.robot).SetDiscreteState(
            np.tile(inverse_kinematics(pose), 2)
        )
        self.set_target(pose)
        self.simulator.Initialize()

    def set_target(self, pose):
        context = self.context_of(self.target)
        self.target.get_mutable_source_value(context).set_value(pose)

    @property
    def measured_pose(self):
        output = self.robot.get_output_port()
        return hand_pose(output.Eval(self.context_of(self.robot)))

    @property
    def fault(self):
        output = self.guard.GetOutputPort("fault")
        return Fault(int(output.Eval(self.context_of(self.guard))[0]))


def test_ideal_robot_executes_all_actions():
    dut = ServoAndGuard()
    for start in (START, np.array([0.25, -0.25, 2.5])):
        dut.reset(start)
        target = start
        for action in range(NUM_ACTIONS):
            target = hand_targets(target, np.array(action))
            dut.set_target(target)
            dut.simulator.AdvanceTo(dut.simulator.get_context().get_time() + 1.8)
            assert dut.fault == Fault.NONE
            np.testing.assert_allclose(dut.measured_pose, target, atol=1e-4)


@pytest.mark.parametrize(("height", "good"), [(0.0005, True), (0.003, False)])
def test_the_hand_has_to_begin_at_its_height(height, good):
    start = inverse_kinematics(np.array([0.5, 0.1, 0.2]), PUSHING_HEIGHT + height)
    with nullcontext() if good else pytest.raises(InputError, match="does not stand"):
        HandServo().check_start(start)
