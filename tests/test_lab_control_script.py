"""The program of the virtual robot's controller: commands, motions, watchdog."""

import math

from controller_bench import (
    DONE,
    GET_STEP_TIME,
    MOVE_J,
    MOVE_L,
    READY,
    SERVO_STOP,
    SET_WATCHDOG,
    SPEED_J,
    SPEED_STOP,
    START,
    STOP_J,
    STOP_SCRIPT,
    Bench,
    assert_rests_soon,
)
import numpy as np
import pytest

from rhp_drake.lab.controller import (
    Controller,
)
from rhp_drake.lab.modes import RuntimeState, SafetyMode
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import forward_kinematics


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


def test_servo_stop_is_in_the_hands_terms():
    bench = Bench()
    q = bench.positions[-1].copy()
    for _ in range(50):
        # Wrist 3 turns back what pan turns: the hand does not turn.
        q = q + 1.0 * COMMAND_PERIOD * np.array([1, 0, 0, 0, 0, 1])
        bench.servo(q)
    before, now = (forward_kinematics(x)[:3, 3] for x in bench.positions[-2:])
    speed = np.linalg.norm(now - before) / COMMAND_PERIOD
    ticks = bench.run(SERVO_STOP, 2.0)
    assert ticks * COMMAND_PERIOD == pytest.approx(speed / 2.0, abs=0.02)


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
