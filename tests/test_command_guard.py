"""Tests of rhp_drake.systems.command_guard."""

import math

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
import pytest

from rhp_drake.errors import InputError
from rhp_drake.safety import Fault, describe
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import PUSHING_HEIGHT, inverse_kinematics
from rhp_drake.systems.command_guard import CommandGuard, CommandGuardConfig
from rhp_drake.task import WORKSPACE_UPPER

START = inverse_kinematics(np.array([0.5, 0.0, 0.2]))
SMALL = 0.9 * CommandGuardConfig().velocity_limit * COMMAND_PERIOD


NUM_OBJECTS = 2


class Bench:
    """A guard in a simulator, one tick at a time."""

    def __init__(self, measured=START):
        self.guard = CommandGuard(CommandGuardConfig(), NUM_OBJECTS)
        self.simulator = Simulator(self.guard)
        self.context = self.simulator.get_mutable_context()
        self.ticks = 0
        self.give(START, measured)
        self.know()
        self.simulator.Initialize()

    def give(self, desired, measured):
        self.guard.GetInputPort("position").FixValue(self.context, desired)
        self.guard.GetInputPort("position_measured").FixValue(self.context, measured)

    def know(
        self,
        *,
        arm_age=0.0,
        arm_fault=Fault.NONE,
        object_ages=(0.0, 0.0),
        roll_deg=0.0,
        x=0.5,
    ):
        tilted = RigidTransform(RollPitchYaw(np.deg2rad(roll_deg), 0, 1), [x, 0, 0.03])
        poses = AbstractValue.Make([RigidTransform([0.5, 0.2, 0.03]), tilted])
        self.guard.GetInputPort("object_poses").FixValue(self.context, poses)
        for name, value in (
            ("arm_age", [arm_age]),
            ("arm_fault", [float(arm_fault)]),
            ("object_ages", object_ages),
        ):
            self.guard.GetInputPort(name).FixValue(self.context, value)

    def tick(self, desired, measured=None):
        """The command and the fault after a tick; a perfect arm if none is given."""
        self.give(desired, self.position if measured is None else measured)
        self.ticks += 1
        self.simulator.AdvanceTo((self.ticks - 0.5) * COMMAND_PERIOD)
        return self.position, self.fault

    @property
    def position(self):
        return self.guard.GetOutputPort("position").Eval(self.context)

    @property
    def fault(self):
        return Fault(int(self.guard.GetOutputPort("fault").Eval(self.context)[0]))


def test_starts_at_measured_position():
    dut = Bench()
    np.testing.assert_array_equal(dut.position, START)
    assert dut.fault == Fault.NONE


def test_is_nan_before_initialization():
    guard = CommandGuard(CommandGuardConfig(), NUM_OBJECTS)
    context = guard.CreateDefaultContext()
    assert np.isnan(guard.GetOutputPort("position").Eval(context)).all()


def test_passes_safe_commands_on():
    dut = Bench()
    desired = START
    for _ in range(20):
        # Pan and wrist 3 leave the hand at its height.
        desired = np.add(desired, [SMALL, 0, 0, 0, 0, SMALL])
        position, fault = dut.tick(desired)
        np.testing.assert_array_equal(position, desired)
        assert fault == Fault.NONE


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_finite(bad):
    dut = Bench()
    desired = START.copy()
    desired[3] = bad
    position, fault = dut.tick(desired)
    assert fault == Fault.NOT_FINITE
    np.testing.assert_array_equal(position, START)


def test_measurement_not_finite():
    assert Bench().tick(START, np.full(6, math.nan))[1] == Fault.NOT_FINITE


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
def test_position_limit(joint, sign):
    limit = CommandGuardConfig().position_limits[joint]
    assert limit == (math.pi if joint == 2 else 2 * math.pi)
    start = START.copy()
    start[joint] = sign * (limit - SMALL / 2)
    dut = Bench(measured=start)
    desired = start.copy()
    desired[joint] = sign * (limit + SMALL / 4)
    position, fault = dut.tick(desired)
    assert fault == Fault.POSITION_LIMIT
    np.testing.assert_array_equal(position, start)


def test_velocity_limit_is_per_tick():
    dut = Bench()
    step = CommandGuardConfig().velocity_limit * COMMAND_PERIOD
    desired = np.add(START, [0.99 * step, 0, 0, 0, 0, 0])
    assert dut.tick(desired)[1] == Fault.NONE
    position, fault = dut.tick(np.add(desired, [0, 0, 0, 0, 0, -1.01 * step]))
    assert fault == Fault.VELOCITY_LIMIT
    np.testing.assert_array_equal(position, desired)


def test_a_first_command_far_away_is_refused():
    dut = Bench()
    position, fault = dut.tick(START + 0.5)
    assert fault == Fault.VELOCITY_LIMIT
    np.testing.assert_array_equal(position, START)


def test_tracking_error():
    dut = Bench()
    limit = CommandGuardConfig().tracking_limit
    stuck = np.add(START, [0, 0.99 * limit, 0, 0, 0, 0])
    assert dut.tick(START, stuck)[1] == Fault.NONE
    stuck = np.add(START, [0, 1.01 * limit, 0, 0, 0, 0])
    assert dut.tick(START, stuck)[1] == Fault.TRACKING_ERROR


def test_fault_is_latched_until_initialization():
    dut = Bench()
    dut.tick(np.full(6, math.nan))
    for _ in range(3):
        position, fault = dut.tick(START + SMALL)
        assert fault == Fault.NOT_FINITE
        np.testing.assert_array_equal(position, START)
    elsewhere = START + 1.0
    dut.give(elsewhere, elsewhere)
    dut.simulator.Initialize()
    assert dut.fault == Fault.NONE
    np.testing.assert_array_equal(dut.position, elsewhere)


def test_refuses_to_start_without_a_position():
    with pytest.raises(RuntimeError, match="not finite"):
        Bench(measured=np.full(6, math.nan))


def test_config_loads_from_yaml():
    config = yaml_load_typed(
        schema=CommandGuardConfig,
        data="velocity_limit: 0.5",
        defaults=CommandGuardConfig(),
    )
    assert config.velocity_limit == 0.5
    assert config.position_limits == CommandGuardConfig().position_limits


@pytest.mark.parametrize(
    "config",
    [
        CommandGuardConfig(velocity_limit=0.0),
        CommandGuardConfig(tracking_limit=math.nan),
        CommandGuardConfig(velocity_limit=math.inf),
        # As good as none.
        CommandGuardConfig(velocity_limit=15.0),
        CommandGuardConfig(tracking_limit=1.0),
        CommandGuardConfig(position_limits=[1.0]),
        CommandGuardConfig(object_age_limit=-1.0),
        CommandGuardConfig(object_age_limit=80.0),
        CommandGuardConfig(workspace_margin=2.0),
        CommandGuardConfig(height_tolerance=math.nan),
    ],
)
def test_bad_config(config):
    with pytest.raises(InputError, match="positive"):
        CommandGuard(config, NUM_OBJECTS)


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ({"arm_age": 0.051}, Fault.STALE_MEASUREMENT),
        ({"arm_age": math.nan}, Fault.STALE_MEASUREMENT),
        ({"object_ages": (0.0, 0.081)}, Fault.STALE_POSE),
        ({"object_ages": (math.inf, 0.0)}, Fault.STALE_POSE),
        ({"object_ages": (0.0, math.nan)}, Fault.STALE_POSE),
        ({"arm_fault": Fault.PROTECTIVE_STOP}, Fault.PROTECTIVE_STOP),
        ({"roll_deg": 16.0}, Fault.OBJECT_TILTED),
        ({"roll_deg": -90.0}, Fault.OBJECT_TILTED),
        ({"roll_deg": 90.0, "object_ages": (0.0, 1.0)}, Fault.STALE_POSE),
        ({"x": 0.531}, Fault.OBJECT_JUMPED),
        ({"arm_fault": Fault.CONNECTION_LOST}, Fault.CONNECTION_LOST),
        ({"arm_fault": 99}, Fault.NOT_RUNNING),
        ({"arm_fault": -1}, Fault.NOT_RUNNING),
        ({"arm_fault": math.nan}, Fault.NOT_RUNNING),
        ({"arm_fault": math.inf}, Fault.NOT_RUNNING),
        ({"x": math.nan}, Fault.NOT_FINITE),
        ({"x": math.inf}, Fault.NOT_FINITE),
        ({"x": math.nan, "object_ages": (0.0, math.inf)}, Fault.STALE_POSE),
    ],
)
def test_old_measurements_and_faults_of_the_robot_stop_the_arm(known, expected):
    dut = Bench()
    dut.know(arm_age=0.049, object_ages=(0.079, 0.0), roll_deg=14.0)
    assert dut.tick(START)[1] == Fault.NONE
    dut.know(**known)
    moved = np.add(START, [SMALL, 0, 0, 0, 0, 0])
    position, fault = dut.tick(moved)
    assert fault == expected
    np.testing.assert_array_equal(position, START)
    # It stays so when all is well again.
    dut.know()
    assert dut.tick(START)[1] == expected


def test_objects_may_be_pushed_and_fall_off_the_table():
    dut = Bench()
    for x in np.arange(0.5, 0.9, 0.029):
        dut.know(x=x)
        assert dut.tick(START)[1] == Fault.NONE
    dut.know(roll_deg=60.0, x=0.95)
    assert dut.tick(START)[1] == Fault.NONE


def test_a_pose_turned_by_nan_stops_the_arm():
    dut = Bench()
    turned = RigidTransform(np.column_stack([np.full((3, 3), np.nan), [0.5, 0, 0.03]]))
    poses = [RigidTransform([0.5, 0.2, 0.03]), turned]
    dut.guard.GetInputPort("object_poses").FixValue(
        dut.context, AbstractValue.Make(poses)
    )
    assert dut.tick(START)[1] == Fault.NOT_FINITE


def test_two_objects_that_change_places_stop_the_arm():
    dut = Bench()
    assert dut.tick(START)[1] == Fault.NONE
    poses = [RigidTransform([0.5, 0.0, 0.03]), RigidTransform([0.5, 0.2, 0.03])]
    dut.guard.GetInputPort("object_poses").FixValue(
        dut.context, AbstractValue.Make(poses)
    )
    assert dut.tick(START)[1] == Fault.OBJECT_JUMPED


@pytest.mark.parametrize(
    ("pose", "height", "fault"),
    [
        ((0.5, 0.0, 0.2), PUSHING_HEIGHT + 0.003, Fault.NONE),
        ((0.5, 0.0, 0.2), PUSHING_HEIGHT + 0.005, Fault.HAND_OUTSIDE),
        ((0.5, 0.0, 0.2), PUSHING_HEIGHT - 0.005, Fault.HAND_OUTSIDE),
        ((0.5, WORKSPACE_UPPER[1] + 0.015, 0.2), PUSHING_HEIGHT, Fault.NONE),
        ((0.5, WORKSPACE_UPPER[1] + 0.025, 0.2), PUSHING_HEIGHT, Fault.HAND_OUTSIDE),
        ((0.175, 0.0, 0.2), PUSHING_HEIGHT, Fault.HAND_OUTSIDE),
    ],
)
def test_the_hand_stays_over_its_workspace_at_its_height(pose, height, fault):
    start = inverse_kinematics(np.array(pose), height)
    assert Bench(measured=start).tick(start)[1] == fault


def test_the_hand_stays_upright():
    leaning = np.add(START, [0, 0, 0, 0, 0.04, 0])
    assert Bench(measured=leaning).tick(leaning)[1] == Fault.HAND_OUTSIDE


def test_all_faults_have_a_sentence():
    assert all(describe(fault).endswith(".") for fault in Fault)
