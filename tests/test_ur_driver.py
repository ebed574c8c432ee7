"""The UR driver, against a virtual robot: it obeys, and it stops the arm."""

import math
import os
import signal
from threading import Thread
import time

import numpy as np
import pytest
from robot_process import START, running_robot, wait_until

from rhp_drake.drivers import ur_stream
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.drivers.ur_driver import UrDriver
from rhp_drake.errors import InputError
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.lab.rtde_server import Stream
from rhp_drake.safety import Fault, JointLimits
from rhp_drake.station.ports import COMMAND_PERIOD

pytest.importorskip("rtde_control")

HOST = "127.0.0.23"  # Of this module alone: the robot's ports are fixed.
SPEED = 0.3  # rad/s


@pytest.fixture(scope="module")
def robot_process():
    with running_robot(HOST) as robot:
        yield robot


@pytest.fixture
def robot(robot_process):
    """The robot, ready and near `START`, its stream in order."""
    robot_process("rtde", "set", "stream", Stream.LIVE)
    robot_process("controller", "reboot")
    robot_process("controller", "release_brakes")
    robot_process.since = robot_process("controller", "outputs")["timestamp"]
    return robot_process


def make_driver(**changes):
    # Patient: the machine may have other things to do.
    values = {"host": HOST, "command_timeout": 0.5, "connection_timeout": 30.0}
    return UrDriver(UrDriverConfig(**values | changes), COMMAND_PERIOD)


@pytest.fixture
def driver(robot):
    driver = make_driver()
    driver.start()
    yield driver
    driver.stop()


def follow(driver, target, condition):
    """Commands the way to the target until the condition holds.

    Returns the last command.
    """
    q = driver.read().position

    def done():
        nonlocal q
        q = q + np.clip(target - q, -SPEED * COMMAND_PERIOD, SPEED * COMMAND_PERIOD)
        driver.command(q, engaged=True)
        return condition()

    wait_until(done, "the condition of a motion")
    return q


def set_in_motion(driver):
    target = driver.read().position + 1.0
    start = driver.read().position
    return follow(
        driver, target, lambda: np.abs(driver.read().position - start).max() > 0.05
    )


def is_at_rest(robot):
    outputs = robot("controller", "outputs")
    return not np.any(outputs["actual_qd"])


def servo_targets(robot):
    """All positions that the controller was told to go to in this test."""
    commands = robot("controller", "commands")
    return np.array(
        [
            command.arguments[:6]
            for command in commands
            if command.name == "servoJ" and command.time > robot.since
        ]
    )


def test_it_measures_and_moves_nothing_until_engaged(robot, driver):
    measured = driver.read()
    np.testing.assert_allclose(
        measured.position, robot("controller", "outputs")["actual_q"], atol=1e-3
    )
    assert measured.fault == Fault.NONE
    driver.command(measured.position + 1.0, engaged=False)
    time.sleep(0.1)
    assert driver.read().fault == Fault.NONE
    assert driver.read().cycles == 0
    assert is_at_rest(robot)


def test_it_follows(robot, driver):
    target = driver.read().position + 0.1

    def there():
        return np.abs(driver.read().position - target).max() < 1e-3

    follow(driver, target, there)
    assert driver.read().fault == Fault.NONE
    assert driver.read().cycles > 10
    steps = np.abs(np.diff(servo_targets(robot), axis=0))
    assert steps.max() <= 2 * JointLimits().velocity_limit * COMMAND_PERIOD


def test_an_arm_that_rests_may_wait_for_its_next_command(robot, driver):
    position = driver.read().position
    driver.command(position, engaged=True)
    time.sleep(0.8)  # More than the time-out of an arm that moves.
    assert driver.read().fault == Fault.NONE
    set_in_motion(driver)
    assert driver.read().fault == Fault.NONE


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda q: np.where(np.arange(6) == 2, math.nan, q), Fault.NOT_FINITE),
        (lambda q: np.where(np.arange(6) == 2, 3.2, q), Fault.POSITION_LIMIT),
        (lambda q: np.where(np.arange(6) == 5, q + 1.5, q), Fault.VELOCITY_LIMIT),
    ],
)
@pytest.mark.parametrize("moving", [False, True])
def test_a_bad_command_never_reaches_the_robot(moving, change, fault, robot, driver):
    if moving:
        set_in_motion(driver)
    bad = change(driver.read().position)
    driver.command(bad, engaged=True)
    wait_until(lambda: driver.read().fault != Fault.NONE, "a fault")
    assert driver.read().fault == fault
    wait_until(lambda: is_at_rest(robot), "the arm to stop")
    # Good ones are too late.
    driver.command(driver.read().position, engaged=True)
    time.sleep(0.1)
    assert driver.read().fault == fault
    targets = servo_targets(robot)
    assert np.isfinite(targets).all()
    assert not len(targets) or np.ptp(targets, axis=0).max() < 0.5


def test_a_moving_arm_that_hears_nothing_more_stops(robot, driver):
    set_in_motion(driver)
    wait_until(lambda: driver.read().fault == Fault.STALE_COMMAND, "a fault")
    wait_until(lambda: is_at_rest(robot), "the arm to stop")


@pytest.mark.parametrize(
    ("machine", "action", "faults"),
    [
        ("controller", ("protective_stop",), {Fault.PROTECTIVE_STOP}),
        ("controller", ("safeguard_stop",), {Fault.EMERGENCY_STOP}),
        ("controller", ("emergency_stop",), {Fault.EMERGENCY_STOP}),
        ("controller", ("reboot",), {Fault.NOT_RUNNING, Fault.EMERGENCY_STOP}),
        ("rtde", ("drop_connections",), {Fault.CONNECTION_LOST}),
        ("rtde", ("set", "stream", Stream.SILENT), {Fault.STALE_MEASUREMENT}),
        ("rtde", ("set", "stream", Stream.REPEATING), {Fault.STALE_MEASUREMENT}),
    ],
)
def test_what_goes_wrong_at_the_robot_stops_the_arm(
    machine, action, faults, robot, driver
):
    q = set_in_motion(driver)
    robot(machine, *action)

    def stopped():
        # Whoever commands does not know yet.
        driver.command(q, engaged=True)
        return driver.read().fault != Fault.NONE

    wait_until(stopped, "a fault")
    assert driver.read().fault in faults
    wait_until(lambda: is_at_rest(robot), "the arm to stop")
    if driver.read().fault == Fault.CONNECTION_LOST:
        return  # ur_rtde may have uploaded its program anew; it does nothing.
    # A paused program would go on to the last position once it is resumed.
    wait_until(
        lambda: robot("controller", "runtime_state") == RuntimeState.STOPPED,
        "the program to end",
    )


def test_age_grows_when_the_robot_falls_silent(robot, driver):
    assert driver.read().age < 5.0
    robot("rtde", "set", "stream", Stream.SILENT)
    before = driver.read().age
    wait_until(lambda: driver.read().age > before + 0.2, "age")


def test_the_controller_stops_the_arm_when_the_driver_is_killed(robot, driver):
    set_in_motion(driver)
    os.kill(driver.pid, signal.SIGKILL)
    wait_until(lambda: is_at_rest(robot), "the arm to stop")
    assert "watchdog" in robot("controller", "stop_reason")
    assert robot("controller", "robot_mode") == RobotMode.RUNNING
    assert driver.read().fault == Fault.CONNECTION_LOST


def test_it_can_be_started_anew(robot):
    for _ in range(2):
        driver = make_driver()
        driver.start()
        set_in_motion(driver)
        driver.stop()
        wait_until(lambda: is_at_rest(robot), "the arm to stop")


def test_a_dry_run_says_where_the_arm_would_be(robot):
    before = robot("controller", "outputs")["actual_q"]
    driver = make_driver(dry_run=True)
    driver.start()
    set_in_motion(driver)
    assert driver.read().fault == Fault.NONE
    assert np.abs(driver.read().position - before).max() > 0.04
    driver.stop()
    assert robot("controller", "outputs")["actual_q"] == before
    assert not len(servo_targets(robot))


def test_a_driver_that_is_forgotten_ends(robot):
    driver = make_driver()
    driver.start()
    process = driver._process
    del driver
    assert not process.is_alive()


def test_nobody_answers():
    driver = make_driver(host="127.0.0.24")
    with pytest.raises(InputError, match=r"cannot be used: .*127\.0\.0\.24 at 30004"):
        driver.start()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (UrDriverConfig(), "host: the robot's address is missing"),
        (UrDriverConfig(host=HOST, gain=50.0), "ur.gain is 50.0; it must be from 100 "),
        (UrDriverConfig(host=HOST, patience=math.nan), "ur.patience is nan"),
        (
            UrDriverConfig(host=HOST, limits=JointLimits(velocity_limit=-1.0)),
            "positive",
        ),
    ],
)
def test_bad_config(config, message):
    with pytest.raises(InputError, match=message):
        UrDriver(config, COMMAND_PERIOD)


class Robot:
    """Stands in for both of ur_rtde's interfaces."""

    def __init__(self, slow=0.0, takes=True):
        self.slow = slow
        self.takes = takes
        self.sent = []
        self.stopped = False

    def getTimestamp(self):
        return time.monotonic()

    def getActualQ(self):
        return list(START)

    def getActualQd(self):
        return [0.0] * 6

    def getSafetyMode(self):
        return int(SafetyMode.NORMAL)

    def getRobotMode(self):
        return int(RobotMode.RUNNING)

    def getRuntimeState(self):
        return int(RuntimeState.PLAYING)

    def isConnected(self):
        return True

    def kickWatchdog(self):
        time.sleep(self.slow)
        return True

    def servoJ(self, q, *arguments):
        self.sent.append(q)
        return self.takes

    def servoStop(self, deceleration):
        self.stopped = True
        return True

    def stopScript(self):
        assert self.stopped


class Cycles:
    """The driver's cycles, one at a time, at times that a test chooses."""

    def __init__(self, robot, **changes):
        self.stream = ur_stream.Stream(
            UrDriverConfig(host=HOST, **changes),
            COMMAND_PERIOD,
            SharedVector(ur_stream.COMMAND_SIZE),
            SharedVector(ur_stream.MEASUREMENT_SIZE),
        )
        self.stream._control = self.stream._receive = robot
        self.stream._connect = lambda: None
        self.now = time.monotonic()

    def command(self, q, engaged=True):
        self.stream._commands.write(np.array([engaged, *q], dtype=float))

    def cycle(self, after=COMMAND_PERIOD, measured=START):
        self.now += after
        return self.stream._follow(measured, self.now)


LIMIT = JointLimits().velocity_limit * COMMAND_PERIOD
PAN = np.array([1.0, 0, 0, 0, 0, 0])


def test_after_a_long_rest_the_arm_is_not_sent_far_away():
    robot = Robot()
    dut = Cycles(robot)
    dut.command(START)
    assert dut.cycle() == Fault.NONE
    assert dut.cycle(after=4.0) == Fault.NONE
    dut.command(START + 0.15 * PAN)
    assert dut.cycle() == Fault.VELOCITY_LIMIT
    np.testing.assert_array_equal(robot.sent, [START, START])


def test_a_command_that_comes_late_is_approached_no_faster_than_allowed():
    robot = Robot()
    dut = Cycles(robot, command_timeout=0.5)
    dut.command(START)
    assert dut.cycle() == Fault.NONE
    # A little less than four commands allow, which rounding must not decide.
    far = START + 3.9 * LIMIT * PAN
    dut.command(far)
    assert dut.cycle(after=3 * COMMAND_PERIOD) == Fault.NONE
    while len(robot.sent) < 6:
        assert dut.cycle() == Fault.NONE
    steps = np.diff(robot.sent, axis=0)[:4, 0]
    np.testing.assert_allclose(steps, np.array([1, 1, 1, 0.9]) * LIMIT)
    np.testing.assert_allclose(robot.sent[-1], far)


def test_commands_may_not_be_too_fast_for_long():
    dut = Cycles(Robot())
    faults = []
    for i in range(8):
        dut.command(START + 1.3 * i * LIMIT * PAN)
        faults.append(dut.cycle())
    # Which is the first to be refused tells how much haste is forgiven.
    assert faults[:4] == [Fault.NONE] * 4
    assert faults[-1] == Fault.VELOCITY_LIMIT


def test_whoever_engages_the_arm_anew_has_to_begin_where_it_is():
    dut = Cycles(Robot())
    dut.command(START)
    assert dut.cycle() == Fault.NONE
    dut.command(START, engaged=False)
    assert dut.cycle() == Fault.NONE
    elsewhere = START - 0.1 * PAN
    dut.command(START)
    assert dut.cycle(measured=elsewhere) == Fault.VELOCITY_LIMIT


def test_a_robot_that_does_not_take_a_command_gets_no_other():
    robot = Robot(takes=False)
    dut = Cycles(robot)
    dut.command(START)
    # In between the robot may say what is wrong with it.
    assert [dut.cycle(), dut.cycle()] == [Fault.NONE, Fault.NOT_RUNNING]
    assert len(robot.sent) == 1


def test_a_call_that_takes_longer_than_the_watchdog_is_a_lost_connection():
    dut = Cycles(Robot(slow=0.15))
    dut.stream.run(lambda: False, pytest.fail)
    assert dut.stream._fault == Fault.CONNECTION_LOST


def test_a_call_that_does_not_return_is_noticed(monkeypatch):
    monkeypatch.setattr(ur_stream, "_STUCK_TIME", 0.05)
    dut = Cycles(Robot(slow=0.5))
    thread = Thread(target=dut.stream.run, args=(lambda: False, pytest.fail))
    thread.start()
    wait_until(lambda: dut.stream.is_stuck, "the driver to be stuck")
    thread.join()
    assert not dut.stream.is_stuck


def test_who_is_told_to_stop_stops_the_arm():
    robot = Robot()
    dut = Cycles(robot)
    dut.command(START)
    dut.stream.run(lambda: len(robot.sent) > 2, pytest.fail)
    assert dut.stream._fault == Fault.NONE
    assert robot.stopped


@pytest.mark.parametrize(
    ("register", "period"), [(0.0, 0.008), (0.002, 0.002), (-0.3, 0.008)]
)
def test_the_period_is_the_controllers(register, period, monkeypatch):
    class Control(Robot):
        def getStepTime(self):
            return register

        def setWatchdog(self, frequency):
            return True

    connect(monkeypatch, Control())
    dut = Cycles(None)
    del dut.stream._connect
    dut.stream.run(lambda: True, pytest.fail)
    assert dut.stream._period == period


def test_without_a_watchdog_nothing_moves(monkeypatch):
    class Control(Robot):
        def getStepTime(self):
            return 0.0

        def setWatchdog(self, frequency):
            return False

    connect(monkeypatch, Control())
    dut = Cycles(None)
    del dut.stream._connect
    problems = []
    dut.stream.run(lambda: False, problems.append)
    assert problems == ["it did not take the watchdog"]


def connect(monkeypatch, robot):
    """Lets the robot answer to whoever connects."""
    for name in (
        "rtde_control.RTDEControlInterface",
        "rtde_receive.RTDEReceiveInterface",
    ):
        monkeypatch.setattr(name, lambda *arguments: robot)
