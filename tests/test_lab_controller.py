"""Tests of rhp_drake.lab.controller and what it consists of."""

import math

import numpy as np
import pytest

from rhp_drake.lab.controller import (
    DEVIATION_LIMIT,
    STOP_PERIODS,
    UNLOCK_DELAY,
    Controller,
)
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.station.ports import COMMAND_PERIOD

START = np.array([0.1, -1.2, 1.5, -1.9, -1.57, 0.3])
# Commands of ur_rtde's script.
MOVE_J, SPEED_J, SERVO_J, SPEED_STOP, SERVO_STOP = 1, 9, 11, 15, 16
MOVE_L, GET_STEP_TIME, PROTECTIVE_STOP, STOP_J, SET_WATCHDOG = 3, 26, 31, 34, 35
STOP_SCRIPT = 255
READY, DONE = 1, 2


class Bench:
    """A controller with an ideal arm, whose program runs, one tick at a time."""

    def __init__(self, start=START):
        self.controller = Controller(start)
        self.ticks = 0
        self.positions = [np.array(start)]
        assert self.controller.start_program()
        self.tick()

    def tick(self, number=1, kick=False):
        """The last position commanded; `kick` the watchdog at each tick."""
        for _ in range(number):
            if kick:
                self.send(0)
            self.ticks += 1
            q = self.positions[-1]
            qd = (q - self.positions[-2]) / COMMAND_PERIOD if self.ticks > 1 else 0 * q
            time = self.ticks * COMMAND_PERIOD
            self.positions.append(self.controller.tick(time, q, qd))
        return self.positions[-1]

    def send(self, number, *reals, alone=0):
        """Writes a command and its arguments."""
        values = {f"input_double_register_{i}": x for i, x in enumerate(reals)}
        self.controller.write_inputs(
            {"input_int_register_0": number, "input_int_register_1": alone, **values}
        )

    def servo(self, q, lookahead_time=0.1):
        self.send(SERVO_J, *q, 0, 0, COMMAND_PERIOD, lookahead_time, 300)
        return self.tick()

    def run(self, number, *reals, limit=1000):
        """A command that the client waits for; the number of ticks it took."""
        assert self.state == READY
        self.send(number, *reals)
        for i in range(limit):
            self.tick()
            if self.state == DONE:
                self.send(0)
                self.tick()
                return i + 1
        raise AssertionError("never done")

    @property
    def state(self):
        return self.controller.outputs()["output_int_register_0"]

    @property
    def speeds(self):
        """Of the joint that is fastest, by tick, rad/s."""
        return np.abs(np.diff(self.positions, axis=0)).max(axis=1) / COMMAND_PERIOD

    def move_along(self, speed=1.0, ticks=50):
        """Servos along a ramp of the first joint."""
        q = self.positions[-1].copy()
        for _ in range(ticks):
            q[0] += speed * COMMAND_PERIOD
            self.servo(q)
        return q


def assert_rests_soon(bench):
    """At rest within the time of a stop, and for good."""
    bench.tick(STOP_PERIODS)
    np.testing.assert_array_equal(bench.tick(50), bench.positions[-51])
    assert np.isfinite(bench.positions).all()


def test_stays_without_a_command():
    bench = Bench()
    np.testing.assert_array_equal(bench.tick(20), START)
    assert bench.state == READY


@pytest.mark.parametrize("position", [np.zeros(5), np.full(6, math.nan)])
def test_needs_a_position(position):
    with pytest.raises(ValueError, match="no arm"):
        Controller(position)


def test_servo_reaches_its_target_and_goes_on_with_it():
    bench = Bench()
    target = START + 0.1
    bench.servo(target)
    # The client says nothing more.
    np.testing.assert_allclose(bench.tick(200), target, atol=1e-6)
    assert bench.controller.runtime_state == RuntimeState.PLAYING


@pytest.mark.parametrize("lookahead_time", [0.03, 0.1, 0.2])
def test_servo_lags_a_ramp_by_the_lookahead_time(lookahead_time):
    bench = Bench()
    q = START.copy()
    for _ in range(300):
        q[0] += 1.0 * COMMAND_PERIOD
        position = bench.servo(q, lookahead_time)
    # The target of a tick is one of a period later.
    assert q[0] - position[0] == pytest.approx(
        lookahead_time - COMMAND_PERIOD, abs=5e-3
    )


def test_servo_stop_decelerates_as_asked():
    bench = Bench()
    bench.move_along(speed=1.0)
    ticks = bench.run(SERVO_STOP, 2.0)
    assert ticks * COMMAND_PERIOD == pytest.approx(0.5, abs=0.02)
    changes = np.diff(bench.speeds[-ticks - 1 :])
    assert (np.abs(changes) <= 2.0 * COMMAND_PERIOD + 1e-9).all()
    assert bench.speeds[-1] == 0
    # And the next command works.
    target = bench.positions[-1] + 0.01
    bench.servo(target)
    np.testing.assert_allclose(bench.tick(100), target, atol=1e-4)


def test_speed():
    bench = Bench()
    bench.send(SPEED_J, 0.5, 0, 0, 0, 0, -0.25, 1.0, 0.0)
    bench.tick(200)
    velocity = np.diff(bench.positions[-2:], axis=0)[0] / COMMAND_PERIOD
    np.testing.assert_allclose(velocity, [0.5, 0, 0, 0, 0, -0.25])
    bench.run(SPEED_STOP, 5.0)
    assert bench.speeds[-1] == 0


@pytest.mark.parametrize("distance", [0.02, 0.5, -1.5])
def test_move(distance):
    bench = Bench()
    target = START + distance * np.array([1, 0.5, 0, 0, 0, -0.2])
    ticks = bench.run(MOVE_J, *target, 1.05, 1.4)
    np.testing.assert_array_equal(bench.positions[-1], target)
    assert bench.speeds.max() <= 1.05 + 1e-9
    assert np.abs(np.diff(bench.speeds)).max() <= 1.4 * COMMAND_PERIOD + 1e-9
    ramp = min(1.05 / 1.4, math.sqrt(abs(distance) / 1.4))
    duration = abs(distance) / (1.4 * ramp) + ramp
    assert ticks * COMMAND_PERIOD == pytest.approx(duration, abs=2 * COMMAND_PERIOD)


def test_move_to_where_it_is():
    assert Bench().run(MOVE_J, *START, 1.0, 1.0) <= 2


def test_move_that_nobody_waits_for():
    def running():
        return bench.controller.outputs()["output_int_register_2"] >> 15 & 1

    bench = Bench()
    bench.send(MOVE_J, *(START + 0.5), 1.0, 1.0, alone=1)
    bench.tick()
    assert bench.state == DONE
    assert running()
    bench.send(0)
    bench.tick(20)
    # Another target on the way: the arm stops first.
    bench.send(MOVE_J, *START, 1.0, 1.0, alone=1)
    bench.tick(500)
    assert not running()
    np.testing.assert_array_equal(bench.positions[-1], START)
    assert np.abs(np.diff(bench.speeds)).max() <= 1.0 * COMMAND_PERIOD + 1e-9


def test_stop_on_the_way():
    bench = Bench()
    bench.send(MOVE_J, *(START + 1), 1.0, 1.0, alone=1)
    bench.tick(50)
    bench.send(0)
    bench.tick()
    bench.run(STOP_J, 2.0)
    np.testing.assert_array_equal(bench.tick(50), bench.positions[-51])


def test_a_command_is_taken_once():
    bench = Bench()
    bench.send(MOVE_J, *(START + 0.1), 1.0, 1.0)
    bench.tick(200)
    bench.send(MOVE_J, *START, 1.0, 1.0)
    # No 0 in between.
    np.testing.assert_array_equal(bench.tick(200), START + 0.1)
    assert [command.name for command in bench.controller.commands] == ["moveJ"]


def test_step_time_is_not_told_by_a_cb3():
    bench = Bench()
    bench.send(GET_STEP_TIME)
    bench.tick(5)
    assert bench.state == READY
    assert "output_double_register_0" not in bench.controller.outputs()


def test_stop_script():
    bench = Bench()
    bench.move_along()
    bench.send(STOP_SCRIPT)
    assert_rests_soon(bench)
    assert bench.controller.runtime_state == RuntimeState.STOPPED
    assert "client" in bench.controller.stop_reason
    # Commands are not taken any more; a new program would take the old one at once.
    bench.send(0)
    bench.servo(START)
    assert_rests_soon(bench)


def test_watchdog():
    bench = Bench()
    bench.run(SET_WATCHDOG, 10.0)
    bench.tick(50, kick=True)
    assert bench.controller.runtime_state == RuntimeState.PLAYING
    bench.move_along(ticks=50)
    heard = bench.ticks
    while bench.controller.runtime_state == RuntimeState.PLAYING:
        bench.tick()
    assert (bench.ticks - heard) * COMMAND_PERIOD == pytest.approx(
        0.1, abs=1.5 * COMMAND_PERIOD
    )
    assert_rests_soon(bench)
    assert bench.controller.safety_mode == SafetyMode.NORMAL
    assert "watchdog" in bench.controller.stop_reason
    # It belongs to the program.
    bench.send(0)
    assert bench.controller.start_program()
    bench.tick(50)
    assert bench.controller.runtime_state == RuntimeState.PLAYING


def far(bench):
    bench.servo(bench.positions[-1] + 0.6)


def fast(bench):
    bench.servo(bench.positions[-1] + 0.45, lookahead_time=0.03)


def beyond_range(bench):
    q = bench.positions[-1].copy()
    q[5] = 2 * math.pi + 0.01
    bench.servo(q)


def not_finite(bench):
    q = bench.positions[-1].copy()
    q[2] = math.nan
    bench.servo(q)


def fast_move(bench):
    bench.controller.stop_program()
    bench.send(0)
    bench.tick(STOP_PERIODS + 1)
    bench.controller.start_program()
    bench.send(MOVE_J, *(START + 3), 4.0, 40.0)
    bench.tick(100)


def blocked(bench):
    # The arm stays behind.
    for _ in range(30):
        bench.ticks += 1
        q = bench.positions[-1]
        far_behind = q - 1.1 * DEVIATION_LIMIT
        time = bench.ticks * COMMAND_PERIOD
        bench.positions.append(bench.controller.tick(time, far_behind, 0 * q))


def asked_by_program(bench):
    bench.send(0)
    bench.tick()
    bench.send(PROTECTIVE_STOP)
    bench.tick()


@pytest.mark.parametrize(
    "fault",
    [far, fast, beyond_range, not_finite, fast_move, blocked, asked_by_program],
)
def test_protective_stop(fault):
    bench = Bench()
    bench.move_along()
    fault(bench)
    controller = bench.controller
    assert controller.safety_mode == SafetyMode.PROTECTIVE_STOP
    assert controller.runtime_state == RuntimeState.PAUSED
    assert controller.stop_reason
    outputs = controller.outputs()
    assert outputs["safety_status_bits"] == 1 << 2 | 1 << 10
    assert outputs["robot_status_bits"] == 1
    assert_rests_soon(bench)
    assert (bench.speeds <= math.pi + 1e-6).all()


def test_a_wild_target_at_rest():
    bench = Bench()
    far(bench)
    assert bench.controller.safety_mode == SafetyMode.PROTECTIVE_STOP
    np.testing.assert_array_equal(bench.tick(50), START)


def test_recovery_from_a_protective_stop():
    bench = Bench()
    bench.move_along()
    controller = bench.controller
    controller.protective_stop()
    assert not controller.start_program()
    assert not controller.resume_program()
    assert not controller.unlock_protective_stop()
    bench.tick(round(UNLOCK_DELAY / COMMAND_PERIOD) + 1)
    assert controller.unlock_protective_stop()
    assert controller.safety_mode == SafetyMode.NORMAL
    assert controller.runtime_state == RuntimeState.PAUSED
    bench.send(0)
    assert controller.start_program()
    assert controller.stop_reason == ""
    target = bench.positions[-1] + 0.1
    bench.servo(target)
    np.testing.assert_allclose(bench.tick(200), target, atol=1e-6)


def test_a_paused_program_goes_on_where_it_was():
    bench = Bench()
    controller = bench.controller
    bench.send(MOVE_J, *(START + 0.5), 1.0, 1.0)
    bench.tick(50)
    assert controller.pause_program()
    assert_rests_soon(bench)
    assert bench.state == READY
    assert controller.resume_program()
    np.testing.assert_array_equal(bench.tick(300), START + 0.5)
    assert bench.state == DONE
    assert np.abs(np.diff(bench.speeds)[70:]).max() <= 1.0 * COMMAND_PERIOD + 1e-9


def test_blocked_arm_is_not_pushed_for_ever():
    bench = Bench()
    bench.move_along()
    stuck = bench.positions[-1] - 1.1 * DEVIATION_LIMIT
    for i in range(1000):
        time = (bench.ticks + i) * COMMAND_PERIOD
        position = bench.controller.tick(time, stuck, np.zeros(6))
        assert np.abs(position - bench.positions[-1]).max() < math.pi * COMMAND_PERIOD
        bench.positions.append(position)
    assert np.abs(position - stuck).max() <= 0.05
    assert bench.controller.unlock_protective_stop()
    bench.ticks += 1000
    bench.tick()
    assert bench.controller.safety_mode == SafetyMode.NORMAL


def test_emergency_stop_and_power():
    bench = Bench()
    bench.move_along()
    controller = bench.controller
    controller.emergency_stop()
    assert_rests_soon(bench)
    assert controller.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP
    assert controller.robot_mode == RobotMode.POWER_OFF
    assert controller.runtime_state == RuntimeState.STOPPED
    assert controller.outputs()["safety_status_bits"] == 1 << 6 | 1 << 7 | 1 << 10
    # No lesser stop hides it, and nothing but the button ends it.
    controller.protective_stop()
    controller.restart_safety()
    controller.power_on()
    assert controller.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP
    assert controller.robot_mode == RobotMode.POWER_OFF
    controller.release_emergency_stop()
    assert not controller.start_program()
    controller.power_on()
    assert controller.robot_mode == RobotMode.IDLE
    assert not controller.start_program()
    controller.release_brakes()
    assert controller.robot_mode == RobotMode.RUNNING
    assert controller.start_program()


def test_safeguard_stop():
    bench = Bench()
    bench.move_along()
    bench.controller.safeguard_stop()
    assert_rests_soon(bench)
    assert bench.controller.safety_mode == SafetyMode.SAFEGUARD_STOP
    bench.controller.release_safeguard_stop()
    assert bench.controller.safety_mode == SafetyMode.NORMAL
    assert bench.controller.runtime_state == RuntimeState.PAUSED


def test_measurement_not_finite():
    bench = Bench()
    bench.move_along()
    controller = bench.controller
    for i in range(3):
        time = (bench.ticks + 1 + i) * COMMAND_PERIOD
        position = controller.tick(time, np.full(6, math.nan), np.zeros(6))
        assert np.isfinite(position).all()
    assert controller.safety_mode == SafetyMode.FAULT
    assert np.isfinite(controller.outputs()["actual_q"]).all()
    controller.restart_safety()
    controller.release_brakes()
    assert controller.start_program()


def test_power_off_and_reboot():
    bench = Bench()
    bench.move_along()
    bench.controller.power_off()
    assert_rests_soon(bench)
    bench.controller.release_brakes()
    bench.controller.start_program()
    bench.move_along()
    bench.controller.reboot()
    assert_rests_soon(bench)
    assert bench.controller.robot_mode == RobotMode.POWER_OFF
    # The old servoJ is forgotten.
    bench.controller.release_brakes()
    bench.controller.start_program()
    assert_rests_soon(bench)


def test_two_threads_may_not_move_the_arm():
    bench = Bench()
    bench.servo(START + 0.1)
    bench.send(MOVE_J, *START, 1.0, 1.0)
    bench.tick()
    assert bench.controller.runtime_state == RuntimeState.STOPPED
    assert "another thread" in bench.controller.stop_reason


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ((MOVE_L, *START, 1.0, 1.0), "not simulated"),
        ((MOVE_J, *START, 0.0, 1.0), "not positive"),
        ((SERVO_STOP, 0.0), "not positive"),
        ((SET_WATCHDOG, 0.0), "not positive"),
    ],
)
def test_commands_that_end_the_program(command, reason):
    bench = Bench()
    bench.send(*command)
    bench.tick()
    assert bench.controller.runtime_state == RuntimeState.STOPPED
    assert reason in bench.controller.stop_reason
    np.testing.assert_array_equal(bench.tick(50), START)


def test_commands_are_remembered():
    bench = Bench()
    bench.servo(START + 0.01)
    bench.tick(3)
    bench.send(SERVO_STOP, 10.0)
    bench.tick()
    servo, stop = bench.controller.commands
    assert (servo.name, stop.name) == ("servoJ", "servoStop")
    assert servo.arguments[:6] == tuple(START + 0.01)
    assert servo.time == pytest.approx(2 * COMMAND_PERIOD)
    assert stop.arguments[0] == 10.0
