"""The UR driver's process, a cycle at a time, with a robot that does as it is told."""

from threading import Thread
import time

import numpy as np
import pytest
from robot_process import START, wait_until

from rhp_drake.drivers import ur_stream
from rhp_drake.drivers.command_periods import BIN_WIDTH, CommandPeriods
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.safety import Fault, JointLimits
from rhp_drake.station.ports import COMMAND_PERIOD

pytest.importorskip("rtde_control")


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
            UrDriverConfig(host="robot", dry_run=False, **changes),
            COMMAND_PERIOD,
            SharedVector(ur_stream.COMMAND_SIZE),
            SharedVector(ur_stream.MEASUREMENT_SIZE),
            SharedVector(CommandPeriods.SIZE),
        )
        self.stream._control = self.stream._receive = robot
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


def test_an_arm_that_is_let_go_on_its_way_is_stopped():
    dut = Cycles(Robot())
    for q in (START, START + 0.5 * LIMIT * PAN):
        dut.command(q)
        assert dut.cycle() == Fault.NONE
    dut.command(START, engaged=False)
    assert dut.cycle() == Fault.LET_GO


def test_a_robot_that_does_not_take_a_command_gets_no_other():
    robot = Robot(takes=False)
    dut = Cycles(robot)
    dut.command(START)
    # In between the robot may say what is wrong with it.
    assert [dut.cycle(), dut.cycle()] == [Fault.NONE, Fault.NOT_RUNNING]
    assert len(robot.sent) == 1


def test_a_call_that_takes_longer_than_the_watchdog_is_a_lost_connection():
    dut = Cycles(Robot(slow=0.15))
    dut.stream.run(lambda: False)
    assert dut.stream._fault == Fault.CONNECTION_LOST


def test_a_call_that_does_not_return_is_noticed(monkeypatch):
    monkeypatch.setattr(ur_stream, "_STUCK_TIME", 0.05)
    dut = Cycles(Robot(slow=0.5))
    thread = Thread(target=dut.stream.run, args=(lambda: False,))
    thread.start()
    wait_until(lambda: dut.stream.is_stuck, "the driver to be stuck")
    thread.join()
    assert not dut.stream.is_stuck


def test_periods_are_counted():
    periods = CommandPeriods()
    assert periods.count == 0
    assert np.isnan(periods.quantile(0.5))
    for period in [0.008] * 997 + [0.0091, 0.5, 0.7]:
        periods.add(period)
    other = CommandPeriods(periods.vector.copy())
    assert other.count == 1000
    assert other.mean == pytest.approx(np.mean([0.008] * 997 + [0.0091, 0.5, 0.7]))
    assert other.quantile(0.5) == pytest.approx(0.008, abs=1.5 * BIN_WIDTH)
    assert other.quantile(0.998) == pytest.approx(0.0091, abs=1.5 * BIN_WIDTH)
    assert other.quantile(0.999) == other.longest == 0.7
    other.merge(periods)
    assert (other.count, other.longest) == (2000, 0.7)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("getActualQ", [0.0] * 5 + [1e300]),
        ("getActualQ", [np.nan] * 6),
        ("getActualQd", [-20.0] + [0.0] * 5),
        ("getRobotMode", 1 << 30),
        ("getSafetyMode", -7),
    ],
)
def test_a_robot_that_tells_nonsense_gets_nothing_more(name, value, monkeypatch):
    robot = Robot()
    dut = Cycles(robot)
    dut.command(START)
    monkeypatch.setattr(dut.stream, "_stop_arm", lambda: None)
    ticks = iter(range(5))

    def stopping():
        if next(ticks) == 2:
            setattr(robot, name, lambda: value)
        return len(robot.sent) > 2 or dut.stream._fault != Fault.NONE

    dut.stream.run(stopping)
    assert dut.stream._fault == Fault.IMPLAUSIBLE_MEASUREMENT
    assert len(robot.sent) == 2
    # What it told before is what is passed on.
    measured, _ = dut.stream._measurements.read()
    np.testing.assert_array_equal(measured[:12], [*START, *np.zeros(6)])


def test_after_another_fault_too_a_lost_connection_ends_the_driver():
    """Else ur_rtde would upload its program anew, which has no watchdog."""
    robot = Robot()
    dut = Cycles(robot)
    dut.command(np.full(6, np.nan))
    ticks = iter(range(100))

    def stopping():
        if next(ticks) == 3:
            robot.isConnected = lambda: False
        return False

    dut.stream.run(stopping)
    assert dut.stream._fault == Fault.NOT_FINITE
    assert next(ticks) < 10


def test_who_is_told_to_stop_stops_the_arm():
    robot = Robot()
    dut = Cycles(robot)
    dut.command(START)
    dut.stream.run(lambda: len(robot.sent) > 2)
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
    dut.stream.connect()
    assert dut.stream._period == period


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("getRobotMode", RobotMode.POWER_OFF, "the robot is off"),
        ("getSafetyMode", SafetyMode.PROTECTIVE_STOP, "in a protective stop"),
    ],
)
def test_a_robot_that_cannot_move_is_sent_no_program(name, value, message, monkeypatch):
    robot = Robot()
    setattr(robot, name, lambda: int(value))
    connect(monkeypatch, robot)
    monkeypatch.setattr("rtde_control.RTDEControlInterface", None)
    dut = Cycles(None)
    with pytest.raises(RuntimeError, match=message):
        dut.stream.connect()


def test_without_a_watchdog_nothing_moves(monkeypatch):
    class Control(Robot):
        def getStepTime(self):
            return 0.0

        def setWatchdog(self, frequency):
            return False

    connect(monkeypatch, Control())
    dut = Cycles(None)
    with pytest.raises(RuntimeError, match="it did not take the watchdog"):
        dut.stream.connect()


def connect(monkeypatch, robot):
    """Lets the robot answer to whoever connects."""
    for name in (
        "rtde_control.RTDEControlInterface",
        "rtde_receive.RTDEReceiveInterface",
    ):
        monkeypatch.setattr(name, lambda *arguments: robot)
