"""The process of the UR driver: what streams to the robot.

It takes the newest command from shared memory and sends it, by `servoJ`, at the
controller's own rate (125 Hz on a CB3, 500 Hz on an e-Series); it writes what the robot
measures to shared memory.

It trusts nobody: it checks every command, and stops the arm when a check fails, when
commands cease to come while the arm moves, when the robot leaves normal operation or
the connection is lost.  Then the fault is latched, and the arm stays stopped until a
new driver is started.  If this process itself dies, the controller's watchdog stops
the arm.  Until it is engaged no motion is asked for at all.
"""

from collections.abc import Callable
import math
import multiprocessing
from multiprocessing.connection import Connection, wait
from multiprocessing.synchronize import Event
import os
import signal
import sys
from threading import Thread
import time
import traceback
from typing import Any, Final

import numpy as np

from rhp_drake.drivers.command_follower import CommandFollower
from rhp_drake.drivers.command_periods import CommandPeriods
from rhp_drake.drivers.realtime import ask_for_realtime, leave_realtime
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.drivers.ur_modes import PROGRAM_RUNNING, check_robot
from rhp_drake.safety import NUM_JOINTS, Fault, describe

# ur_rtde ignores speed and acceleration of servoJ, but checks their ranges.
_UNUSED: Final = 0.5
# m/s^2 of the tool, since servoStop ends in stopl, and rad/s^2.  The hand turns no
# faster than 0.6 rad/s: it is at rest before the watchdog ends the program, which
# brakes less hard.
_DECELERATION: Final = 20.0
# Hz: the controller stops by itself when it hears less often from us, that is after
# five commands of a CB3 that did not come.
_WATCHDOG_FREQUENCY: Final = 25.0
_CB3_PERIOD: Final = 0.008  # s
_E_SERIES_PERIOD: Final = 0.002  # s
# A call of the library that takes so long tries to connect anew, for ever.
_STUCK_TIME: Final = 1.0  # s
_WATCH_PERIOD: Final = 0.1  # s
# How long the arm may take to brake, and the process to end.
STOP_TIME: Final = 2.0  # s
_DASHBOARD_TIMEOUT: Final = 500  # ms
_VARIABLES: Final = [
    "timestamp",
    "actual_q",
    "actual_qd",
    "robot_mode",
    "safety_mode",
    "runtime_state",
]
# Faults in which the robot is well and waits for what it is told.
_OURS: Final = (
    Fault.NOT_FINITE,
    Fault.POSITION_LIMIT,
    Fault.VELOCITY_LIMIT,
    Fault.TRACKING_ERROR,
    Fault.STALE_COMMAND,
    Fault.LET_GO,
)

# Layout of the shared vectors.
COMMAND_SIZE: Final = 1 + NUM_JOINTS  # Whether engaged, positions.
# q, qd, when they came (time.monotonic), fault.
MEASUREMENT_SIZE: Final = 2 * NUM_JOINTS + 2


def serve(
    config: UrDriverConfig,
    command_period: float,
    commands: SharedVector,
    measurements: SharedVector,
    periods: SharedVector,
    stopping: Event,
    problem: Connection,
) -> None:
    """The driver's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    stream = Stream(config, command_period, commands, measurements, periods)

    def watch() -> None:
        while not wait([parent.sentinel], timeout=_WATCH_PERIOD):
            if stream.is_stuck:
                # Before the library uploads its program anew, without a watchdog.
                os._exit(1)
        stopping.set()
        # Nobody is left to end what does not end by itself.
        time.sleep(STOP_TIME)
        os._exit(1)

    Thread(target=watch, daemon=True).start()
    try:
        try:
            stream.connect()
        except (RuntimeError, ValueError) as error:
            problem.send(str(error))
            return
        # Only now: the library waits in loops, until the robot answers.
        if not ask_for_realtime():
            print(
                "rhp: no real-time scheduling for the robot's driver: a busy computer "
                "may stop the arm for nothing (limit rtprio).",
                file=sys.stderr,
                flush=True,
            )
        stream.run(stopping.is_set)
    except Exception:
        # Nothing is sent any more, so that the watchdog stops the arm.
        traceback.print_exc()
    finally:
        # The library's threads may hang on a dead connection.
        os._exit(0)


class Stream:
    """The driver's loop: measure, check, command."""

    def __init__(
        self,
        config: UrDriverConfig,
        command_period: float,
        commands: SharedVector,
        measurements: SharedVector,
        periods: SharedVector,
    ) -> None:
        self._config = config
        self._commands = commands
        self._measurements = measurements
        self._shared_periods = periods
        self._fault = Fault.NONE
        self._receive: Any = None
        self._control: Any = None
        self._period = command_period
        self._follower = CommandFollower(config, command_period)
        # When the newest command was written that was looked at.
        self._stamp = np.nan
        # Whether the robot did not take what was sent last.
        self._refused = False
        self._periods = CommandPeriods()
        self._sent_at = np.nan
        # When the call of the library began that has not returned, s; else inf.
        self._calling_since = np.inf

    @property
    def is_stuck(self) -> bool:
        """Whether the library does not return; may be asked from any thread."""
        return time.monotonic() - self._calling_since > _STUCK_TIME

    def run(self, stopping: Callable[[], bool]) -> None:
        """Until told to stop; the first measurement tells that it is connected.

        Args:
            stopping: Whether to stop.
        """
        timestamp, heard_at = np.nan, time.monotonic()
        cycle = time.monotonic()
        position = velocity = np.full(NUM_JOINTS, np.nan)
        while not stopping():
            now = time.monotonic()
            fault = Fault.NONE
            try:
                if self._receive.getTimestamp() != timestamp:
                    timestamp, heard_at = self._receive.getTimestamp(), now
                measured = self._measure()
                fault = self._check_robot(now - heard_at, *measured)
                if fault != Fault.IMPLAUSIBLE_MEASUREMENT:
                    position, velocity = measured
                if fault == self._fault == Fault.NONE:
                    self._calling_since = now
                    fault = self._follow(position, now)
                    passed = self._receive.getTimestamp() - timestamp
                    if fault == Fault.NONE and passed > 1 / _WATCHDOG_FREQUENCY:
                        # By now the watchdog has ended the program.  If it runs all
                        # the same the library has connected anew meanwhile, and its
                        # new program has no watchdog.
                        fault = Fault.CONNECTION_LOST
            except (RuntimeError, ValueError):
                # What the library throws when it has lost the robot.
                fault = Fault.CONNECTION_LOST
            self._calling_since = np.inf
            new_fault = fault != self._fault == Fault.NONE
            if new_fault:
                self._fault = fault
            if self._config.dry_run and self._follower.accepted is not None:
                position = self._follower.accepted
            # A frozen stream looks old, whatever is read from it.
            rest = [heard_at, self._fault]
            self._measurements.write(np.concatenate([position, velocity, rest]))
            # After it was told: to stop takes a while.
            if new_fault:
                self._stop_arm()
            # Whatever stopped the arm before.
            if fault == Fault.CONNECTION_LOST:
                # The library would connect anew and upload its program again and again.
                return
            # Late once, it is not early afterwards.
            cycle = max(cycle + self._period, time.monotonic())
            time.sleep(max(0.0, cycle - time.monotonic()))
        if self._fault == Fault.NONE:
            self._stop_arm()

    def connect(self) -> None:
        """Connects to the robot, which may then be moved.

        Raises:
            RuntimeError: If it cannot be used, as a ValueError.
        """
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        host = self._config.host
        self._receive = RTDEReceiveInterface(host, -1.0, _VARIABLES)
        fault = self._check_robot(0.0, *self._measure())
        if fault != Fault.NONE:
            # Nor would it play the library's program.
            raise RuntimeError(describe(fault))
        if not self._config.dry_run:
            self._control = RTDEControlInterface(host)
            # The answer is not waited for: the first time one reads what was in the
            # robot's register before.  A CB3 never answers.
            self._control.getStepTime()
            time.sleep(2 * _CB3_PERIOD)
            is_e_series = math.isclose(
                self._control.getStepTime(), _E_SERIES_PERIOD, rel_tol=0.01
            )
            self._period = _E_SERIES_PERIOD if is_e_series else _CB3_PERIOD
            if not self._control.setWatchdog(_WATCHDOG_FREQUENCY):
                raise RuntimeError("it did not take the watchdog")
            # The first command after another kind of command waits, too.
            self._control.kickWatchdog()

    def _measure(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities of the joints, shape (6,) each, rad and rad/s."""
        receive = self._receive
        return np.array(receive.getActualQ()), np.array(receive.getActualQd())

    def _check_robot(
        self, age: float, position: np.ndarray, velocity: np.ndarray
    ) -> Fault:
        """What the robot says of itself, or that it says nothing."""
        receive = self._receive
        # The library has two connections; the control's it makes anew by itself.
        control = self._control
        if not (receive.isConnected() and (control is None or control.isConnected())):
            return Fault.CONNECTION_LOST
        if age > self._config.measurement_timeout:
            return Fault.STALE_MEASUREMENT
        program = receive.getRuntimeState()
        return check_robot(
            position,
            velocity,
            receive.getRobotMode(),
            receive.getSafetyMode(),
            program_runs=control is None or program == PROGRAM_RUNNING,
        )

    def _follow(self, measured: np.ndarray, now: float) -> Fault:
        """Takes the newest command, if it is safe, and goes there."""
        if self._refused:
            # Only now: by its own stream the robot may have told a better reason.
            return Fault.NOT_RUNNING
        values, stamp = self._commands.read()
        if np.isnan(stamp) or not values[0]:
            # Not engaged, or no more: then the next command has to be where the arm is
            # again.  The controller waits for a sign of life all the same.
            if self._follower.moving:
                # It would go on to what was sent last.
                return Fault.LET_GO
            self._follower.let_go()
            self._sent_at = np.nan
            if self._control is not None:
                self._control.kickWatchdog()
            return Fault.NONE
        if stamp != self._stamp:
            fault = self._follower.accept(values[1:], measured, now)
            if fault != Fault.NONE:
                return fault
            self._stamp = stamp
        config = self._config
        moving = self._follower.moving
        limit = config.command_timeout if moving else config.patience
        if now - stamp > limit:
            return Fault.STALE_COMMAND
        return self._send(now)

    def _send(self, now: float) -> Fault:
        """Sends where the arm is to be by now."""
        if not np.isnan(self._sent_at):
            self._periods.add(now - self._sent_at)
            self._shared_periods.write(self._periods.vector)
        self._sent_at = now
        position = self._follower.next_position(now, self._period)
        if self._control is None:
            return Fault.NONE
        self._refused = not self._control.servoJ(
            position.tolist(),
            _UNUSED,
            _UNUSED,
            self._period,
            self._config.lookahead_time,
            self._config.gain,
        )
        return Fault.NONE

    def _stop_arm(self) -> None:
        """Stops the arm and ends the program that could move it.

        Where the robot is not well it stops by itself: by what it does then, or by its
        watchdog, since nothing is sent any more.  But its program may be paused, and
        would go on to the last position once somebody resumes it.  The library would
        wait for it in vain; the dashboard ends it.
        """
        if self._control is None:
            return
        # The library waits in a loop until the arm is at rest.
        leave_realtime()
        self._calling_since = time.monotonic()
        try:
            if self._fault == Fault.NONE or self._fault in _OURS:
                self._control.servoStop(_DECELERATION)
                self._control.stopScript()
            else:
                from dashboard_client import DashboardClient

                dashboard = DashboardClient(self._config.host)
                dashboard.connect(_DASHBOARD_TIMEOUT)
                dashboard.stop()
        except RuntimeError as error:
            # The watchdog stops the arm.
            print(
                f"rhp: the robot's program could not be ended ({error}): do not resume "
                "it.",
                file=sys.stderr,
                flush=True,
            )
        self._calling_since = np.inf
