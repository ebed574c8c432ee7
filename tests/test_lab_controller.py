"""The virtual robot's controller: what stops the arm, and how it recovers."""

import math

from controller_bench import (
    DONE,
    MOVE_J,
    PROTECTIVE_STOP,
    READY,
    START,
    Bench,
    assert_rests_soon,
)
import numpy as np
import pytest

from rhp_drake.lab.controller import (
    DEVIATION_LIMIT,
    STOP_PERIODS,
    UNLOCK_DELAY,
)
from rhp_drake.lab.modes import RobotMode, RuntimeState, SafetyMode
from rhp_drake.station.ports import COMMAND_PERIOD


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
