"""The driver over LCM: messages both ways, their ages, and what is dropped."""

from dataclasses import replace
import math
import multiprocessing
import struct

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform, RollPitchYaw
import pytest

from rhp_drake.drivers.lcm_config import (
    COMMAND_CHANNEL,
    POSES_CHANNEL,
    STATUS_CHANNEL,
    LcmConfig,
)
from rhp_drake.drivers.lcm_driver import LcmArm, LcmDriver, LcmTracker
from rhp_drake.drivers.lcm_inbox import SenderClock
from rhp_drake.drivers.lcm_receiver import STATUS_SIZE, Receiver
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.drivers.pose_rows import POSE_SIZE
from rhp_drake.drivers.rhp_lcm import (
    lcmt_object_poses,
    lcmt_ur_command,
    lcmt_ur_status,
)
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import WorkError
from rhp_drake.lcm_bridge import LcmBridge
from rhp_drake.safety import Fault
from rhp_drake.station.ports import COMMAND_PERIOD

OBJECTS = ["target", "obstacle_1", "obstacle_2"]
# Of this module alone: LCM's group is everybody's.
URL = "udpm://239.255.76.67:7671?ttl=0"


class Clock:
    """time.monotonic and time.sleep in all of the process."""

    now = 100.0

    def sleep(self, seconds):
        self.now += seconds

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("time.monotonic", clock)
    monkeypatch.setattr("time.sleep", clock.sleep)
    return clock


class Planner:
    """What `rhp run` has of a driver: both ends of the shared memory in one process."""

    def __init__(self, lcm):
        status, poses = SharedVector(STATUS_SIZE), SharedVector(3 * POSE_SIZE)
        self.receiver = Receiver(lcm, OBJECTS, status, poses)
        self.arm, self.tracker = LcmArm(lcm, status, COMMAND_PERIOD), LcmTracker(poses)


class Robot:
    """A driver of a robot."""

    def __init__(self):
        self.measured = ArmMeasurement(np.arange(6.0), -np.ones(6), Fault.NONE, 0.0)
        self.commands = []

    def command(self, position, engaged):
        self.commands.append((position.tolist(), engaged))

    def read(self):
        return self.measured


class Camera:
    """A driver of a tracker."""

    def __init__(self):
        self.poses = [
            ObjectPose(RigidTransform(RollPitchYaw(0.1, 0, yaw), [yaw, 0, 0.03]), 0.01)
            for yaw in (0.5, 1.5, -2.5)
        ]

    def read(self):
        return self.poses


@pytest.fixture
def lcm():
    return DrakeLcm("memq://")


@pytest.fixture
def planner(lcm, clock):
    return Planner(lcm)


@pytest.fixture
def robot():
    return Robot()


@pytest.fixture
def camera():
    return Camera()


@pytest.fixture
def bridge(lcm, clock, robot, camera):
    return LcmBridge(lcm, robot, camera, OBJECTS, max_age=0.06)


def status(utime, measured_utime=None, position=0.0, fault=0):
    message = lcmt_ur_status()
    message.utime = utime
    message.measured_utime = utime if measured_utime is None else measured_utime
    message.joint_position_measured[0] = position
    message.fault = fault
    return message


def poses(utime, **changes):
    message = lcmt_object_poses()
    message.utime = utime
    message.num_objects = 1
    message.name, message.measured_utime = ["target"], [utime]
    message.position, message.quaternion = [[0.5, 0.0, 0.03]], [[1.0, 0.0, 0.0, 0.0]]
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def command(utime, engaged=True, position=0.0):
    message = lcmt_ur_command()
    message.utime, message.engaged = utime, engaged
    message.joint_position = [position] * 6
    return message


def send(lcm, channel, message):
    lcm.Publish(channel, message if isinstance(message, bytes) else message.encode())
    lcm.HandleSubscriptions(0)


def test_both_ways(lcm, clock, planner, bridge, robot, camera):
    assert math.isinf(planner.arm.read().age)
    assert all(math.isinf(pose.age) for pose in planner.tracker.read())
    robot.measured = ArmMeasurement(
        np.arange(6.0), -np.ones(6), Fault.PROTECTIVE_STOP, 0.02
    )
    planner.arm.command(np.full(6, 0.25), engaged=True)
    assert bridge.step() == Fault.PROTECTIVE_STOP
    lcm.HandleSubscriptions(0)
    assert robot.commands == [([0.25] * 6, True)]
    clock.now += 0.5
    measured = planner.arm.read()
    np.testing.assert_array_equal(measured.position, np.arange(6.0))
    np.testing.assert_array_equal(measured.velocity, -np.ones(6))
    assert measured.fault == Fault.PROTECTIVE_STOP
    assert measured.age == pytest.approx(0.52, abs=1e-5)
    for pose, seen in zip(planner.tracker.read(), camera.poses, strict=True):
        assert pose.X_WB.IsNearlyEqualTo(seen.X_WB, 1e-12)
        assert pose.age == pytest.approx(0.51, abs=1e-5)


def test_an_object_that_was_never_seen_is_not_told_of(lcm, planner, bridge, camera):
    camera.poses[1] = ObjectPose(RigidTransform(np.full(3, np.nan)), math.inf)
    bridge.step()
    lcm.HandleSubscriptions(0)
    ages = [pose.age for pose in planner.tracker.read()]
    assert np.isfinite(ages).tolist() == [True, False, True]


def test_objects_go_by_their_names(lcm, planner):
    message = poses(1)
    message.num_objects = 2
    message.name, message.measured_utime = ["cup", "obstacle_2"], [1, 1]
    message.position, message.quaternion = (
        [[9.0, 9.0, 9.0], [0.1, 0.2, 0.3]],
        [[1.0, 0.0, 0.0, 0.0]] * 2,
    )
    send(lcm, POSES_CHANNEL, message)
    seen = planner.tracker.read()
    assert [math.isfinite(pose.age) for pose in seen] == [False, False, True]
    np.testing.assert_array_equal(seen[2].X_WB.translation(), [0.1, 0.2, 0.3])


@pytest.mark.parametrize("epoch", [0, -(10**12), 1_800_000_000 * 10**6])
def test_ages_whatever_the_sender_s_clock_shows(epoch, lcm, clock, planner):
    def send_status(sent, arrives, **values):
        clock.now = 100.0 + arrives
        send(lcm, STATUS_CHANNEL, status(epoch + round(sent * 1e6), **values))
        return planner.arm.read().age

    assert send_status(0.0, 0.001) == pytest.approx(0.0, abs=1e-5)
    # It was on its way for 0.3 s longer than the first.
    assert send_status(0.1, 0.401) == pytest.approx(0.3, abs=1e-3)
    # Overtaken, and repeated: nothing new.
    assert send_status(0.05, 0.501, position=9.0) == pytest.approx(0.4, abs=1e-3)
    assert send_status(0.1, 0.601, position=9.0) == pytest.approx(0.5, abs=1e-3)
    assert planner.arm.read().position[0] == 0.0
    # The robot's stream is frozen, the driver goes on.
    frozen = {"measured_utime": epoch + 600_000}
    assert send_status(0.7, 0.701, **frozen) == pytest.approx(0.1, abs=1e-3)
    assert send_status(1.7, 1.701, **frozen) == pytest.approx(1.1, abs=1e-3)


def test_a_stream_that_is_frozen_from_the_first_looks_old(lcm, planner):
    send(lcm, STATUS_CHANNEL, status(10_000_000, measured_utime=7_000_000))
    assert planner.arm.read().age == pytest.approx(3.0, abs=1e-5)


@pytest.mark.parametrize("rate", [1 - 1e-4, 1 + 1e-4])
def test_clocks_that_drift_apart(rate):
    clock = SenderClock()
    for now in np.arange(0.0, 3600.0, 0.5):
        utime = round(now * rate * 1e6)
        assert clock.receive(utime, now)
        assert 0 <= now - clock.to_ours(utime) < 1e-3


BAD_STATUS = {
    "nothing": b"",
    "noise": bytes(range(256)),
    "too short": status(2).encode()[:-1],
    "of another type": poses(2).encode(),
    "nan": status(2, position=math.nan),
    "infinite": status(2, position=math.inf),
    "measured after it was sent": status(2, measured_utime=3),
}
BAD_POSES = {
    "nothing": b"",
    "noise": bytes(range(256)),
    "too short": poses(2).encode()[:-1],
    "too many": poses(2).encode()[:16] + struct.pack(">i", 2**31 - 1),
    "a negative number": poses(2).encode()[:16] + struct.pack(">i", -1),
    "of another type": status(2).encode(),
    "nan": poses(2, position=[[math.nan, 0.0, 0.0]]),
    "a nan quaternion": poses(2, quaternion=[[math.nan, 0.0, 0.0, 0.0]]),
    "no rotation": poses(2, quaternion=[[0.0, 0.0, 0.0, 0.0]]),
    "seen after it was sent": poses(2, measured_utime=[3]),
}


@pytest.mark.parametrize("message", BAD_STATUS.values(), ids=BAD_STATUS)
def test_a_bad_status_is_dropped(message, lcm, clock, planner, capfd):
    send(lcm, STATUS_CHANNEL, status(1, position=0.5))
    clock.now += 1.0
    send(lcm, STATUS_CHANNEL, message)
    send(lcm, STATUS_CHANNEL, message)
    measured = planner.arm.read()
    assert measured.position[0] == 0.5
    assert measured.age == pytest.approx(1.0, abs=1e-5)
    assert capfd.readouterr().err.count("a message on UR_STATUS is dropped") == 1
    send(lcm, STATUS_CHANNEL, status(1_000_001, position=0.6))
    assert planner.arm.read().position[0] == 0.6


@pytest.mark.parametrize("message", BAD_POSES.values(), ids=BAD_POSES)
def test_bad_poses_are_dropped(message, lcm, clock, planner, capfd):
    send(lcm, POSES_CHANNEL, poses(1))
    clock.now += 1.0
    send(lcm, POSES_CHANNEL, message)
    target = planner.tracker.read()[0]
    assert target.X_WB.translation()[0] == 0.5
    assert target.age == pytest.approx(1.0, abs=1e-5)
    assert "a message on OBJECT_POSES is dropped" in capfd.readouterr().err
    send(lcm, POSES_CHANNEL, poses(1_000_001))
    assert planner.tracker.read()[0].age == pytest.approx(0.0, abs=1e-3)


def test_a_fault_that_nobody_knows_is_a_fault(lcm, planner):
    send(lcm, STATUS_CHANNEL, status(1, fault=99))
    assert planner.arm.read().fault == Fault.NOT_RUNNING


def test_each_command_is_passed_on_once_and_while_it_is_fresh(
    lcm, clock, bridge, robot, capfd
):
    sent, stale = command(1_000_000), command(1_100_000)
    send(lcm, COMMAND_CHANNEL, sent)
    send(lcm, COMMAND_CHANNEL, sent)
    clock.now += 0.2
    send(lcm, COMMAND_CHANNEL, stale)
    send(lcm, COMMAND_CHANNEL, sent.encode()[:-1])
    send(lcm, COMMAND_CHANNEL, b"stop!")
    assert len(robot.commands) == 1
    assert "a message on UR_COMMAND is dropped" in capfd.readouterr().err
    send(lcm, COMMAND_CHANNEL, command(1_200_000))
    assert len(robot.commands) == 2


def test_who_lets_go_may_be_followed_by_one_with_another_clock(
    lcm, clock, bridge, robot
):
    send(lcm, COMMAND_CHANNEL, command(5_000_000))
    send(lcm, COMMAND_CHANNEL, command(1_000_000))
    assert len(robot.commands) == 1
    send(lcm, COMMAND_CHANNEL, command(5_000_001, engaged=False, position=math.nan))
    # One of before that comes only now must not engage the arm again.
    bridge.step()
    send(lcm, COMMAND_CHANNEL, command(4_999_999))
    assert [engaged for _, engaged in robot.commands] == [True, False]
    clock.now += 1.1
    bridge.step()
    send(lcm, COMMAND_CHANNEL, command(1_000_000))
    assert [engaged for _, engaged in robot.commands] == [True, False, True]


def test_who_commanded_lets_go_and_nobody_else(lcm, clock, planner, bridge, robot):
    planner.arm.let_go()
    lcm.HandleSubscriptions(0)
    assert not robot.commands
    planner.arm.command(np.zeros(6), engaged=True)
    clock.now += 0.008
    planner.arm.let_go()
    clock.now += 0.008
    planner.arm.let_go()
    lcm.HandleSubscriptions(0)
    # Said more than once, since it may be lost.
    assert [engaged for _, engaged in robot.commands] == [True, False, False, False]


def test_a_second_planner_is_refused(lcm, clock, planner, bridge, robot):
    driver = LcmDriver(LcmConfig(url=URL, objects=OBJECTS), COMMAND_PERIOD)
    Receiver(lcm, OBJECTS, driver._status, driver._poses)  # As its process would.

    def step():
        clock.now += COMMAND_PERIOD
        bridge.step()
        lcm.HandleSubscriptions(0)

    def start():
        driver.start()
        driver.stop()

    step()
    start()
    planner.arm.command(np.zeros(6), engaged=True)
    step()
    with pytest.raises(WorkError, match=r"another program commands the arm\."):
        start()
    planner.arm.let_go()
    step()
    start()
    # It is killed.
    planner.arm.command(np.zeros(6), engaged=True)
    robot.measured = replace(robot.measured, fault=Fault.STALE_COMMAND)
    step()
    with pytest.raises(WorkError, match="started anew: no command came in time"):
        start()


def test_who_lets_go_too_late_is_still_said_to_command(lcm, clock, planner, bridge):
    send(lcm, COMMAND_CHANNEL, command(1_000_000))
    clock.now += 0.2
    send(lcm, COMMAND_CHANNEL, command(1_100_000, engaged=False))
    bridge.step()
    lcm.HandleSubscriptions(0)
    assert planner.arm.is_commanded()


def test_its_process_ends_even_if_letting_go_fails(monkeypatch):
    def fail(lcm, channel, buffer):
        raise RuntimeError("no network")

    monkeypatch.setattr(DrakeLcm, "Publish", lambda lcm, channel, buffer: None)
    driver = LcmDriver(LcmConfig(url=URL, objects=OBJECTS), COMMAND_PERIOD)
    driver.arm.command(np.zeros(6), engaged=True)
    monkeypatch.setattr(driver, "_WaitForAll", lambda: None)
    others = multiprocessing.active_children()
    driver.start()
    assert len(multiprocessing.active_children()) == len(others) + 1
    monkeypatch.setattr(DrakeLcm, "Publish", fail)
    with pytest.raises(RuntimeError, match="no network"):
        driver.stop()
    assert multiprocessing.active_children() == others
