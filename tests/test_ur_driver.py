"""The UR driver, against a virtual robot: it obeys, and it stops the arm."""

import math
import os
import signal
import socket
import time

import numpy as np
import pytest
from robot_process import make_ready, running_robot, wait_until

from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.drivers.ur_driver import UrDriver
from rhp_drake.errors import InputError
from rhp_drake.lab.modes import RobotMode, RuntimeState
from rhp_drake.lab.rtde_server import RTDE_PORT, Stream
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
    return make_ready(robot_process)


def make_driver(**changes):
    # Patient: the machine may have other things to do.
    values = {
        "host": HOST,
        "command_timeout": 0.5,
        "measurement_timeout": 0.5,
        "connection_timeout": 30.0,
        "dry_run": False,
    }
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
    assert driver.periods.count == 0
    assert is_at_rest(robot)


def test_it_follows(robot, driver):
    target = driver.read().position + 0.1

    def there():
        return np.abs(driver.read().position - target).max() < 1e-3

    follow(driver, target, there)
    assert driver.read().fault == Fault.NONE
    assert driver.periods.count > 10
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


def test_somebody_listens_and_does_not_answer(capfd):
    with socket.create_server(("127.0.0.24", RTDE_PORT)):
        driver = make_driver(host="127.0.0.24", connection_timeout=4.0)
        with pytest.raises(InputError, match="cannot be used: no answer within 4 s"):
            driver.start()
    # Nothing has moved, and there is no watchdog yet.
    assert "watchdog" not in capfd.readouterr().err


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
