"""A UR robot over RTDE, in a process of its own: a long plan never starves its stream.

The process takes the newest command from shared memory and sends it, by `servoJ`, at
the controller's own rate (125 Hz on a CB3, 500 Hz on an e-Series); it writes what the
robot measures to shared memory.  Nobody else touches a socket.

It trusts nobody: it checks every command, and stops the arm when a check fails, when
commands cease to come while the arm moves, when the robot leaves normal operation or
the connection is lost.  Then the fault is latched, and the arm stays stopped until the
driver is started anew.  If this process itself dies, the controller's watchdog stops
the arm.  Until it is engaged no motion is asked for at all.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import multiprocessing
from multiprocessing.connection import wait
from multiprocessing.synchronize import Event
import os
import signal
from threading import Thread
import time
from typing import Any, Final

import numpy as np

from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import InputError
from rhp_drake.safety import Fault, JointLimits, check_command

NUM_JOINTS: Final = 6

# ur_rtde ignores speed and acceleration of servoJ, but checks their ranges.
_UNUSED: Final = 0.5
# rad/s^2 of a stop: from the fastest command allowed that is a fifth of a second.
_DECELERATION: Final = 8.0
# Hz: the controller stops by itself when it hears less often from us.
_WATCHDOG_FREQUENCY: Final = 10.0
_CB3_PERIOD: Final = 0.008  # s
# RTDE guide of Universal Robots: robot and safety modes, and a program that runs.
_ROBOT_RUNNING: Final = 7
_SAFETY_NORMAL: Final = (1, 2)  # Normal, reduced.
_SAFETY_PROTECTIVE: Final = (3, 4)  # Protective stop, recovery.
_PROGRAM_RUNNING: Final = 2
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
)

# Layout of the shared vectors.
_COMMAND_SIZE: Final = 1 + NUM_JOINTS  # Whether engaged, positions.
# q, qd, when they came (time.monotonic), fault, cycles, longest cycle.
_MEASUREMENT_SIZE: Final = 2 * NUM_JOINTS + 4


@dataclass
class UrDriverConfig:
    """How to reach the robot, and what it may be told.

    Attributes:
        host: Its address.
        lookahead_time: Of servoJ, 0.03 to 0.2 s: more is smoother and later.
        gain: Of servoJ, 100 to 2000: more follows closer.
        limits: On commands.
        command_timeout: How long the arm may move without a new command, s.
        patience: How long it may stand still without one, s: a policy thinks while the
            hand rests.
        connection_timeout: How long the robot may take to answer at first, s.
        dry_run: Whether everything is done but moving the arm; it is then said to be
            where it was commanded to be.
    """

    host: str = ""
    lookahead_time: float = 0.1
    gain: float = 300.0
    limits: JointLimits = field(default_factory=JointLimits)
    command_timeout: float = 0.06
    patience: float = 5.0
    connection_timeout: float = 10.0
    dry_run: bool = False

    def validate(self) -> None:
        """Raises an InputError that names the first impossible value."""
        if not self.host:
            raise InputError("ur.host: the robot's address is missing.")
        self.limits.validate()
        for name, low, high in (
            ("lookahead_time", 0.03, 0.2),
            ("gain", 100.0, 2000.0),
            ("command_timeout", 0.01, 1.0),
            ("patience", 0.01, 600.0),
            ("connection_timeout", 0.1, 600.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(
                    f"ur.{name} is {value}; it must be from {low:g} to {high:g}."
                )


@dataclass(frozen=True)
class UrMeasurement:
    """What the driver knows of the robot.

    Attributes:
        position: Of the joints, base to wrist, shape (6,), rad.
        velocity: Likewise, rad/s.
        fault: Why the arm was stopped, if it was.
        age: Since the robot measured this, s.
        cycles: How often a position was sent so far.
        longest_cycle: Longest time between two of them, s.
    """

    position: np.ndarray
    velocity: np.ndarray
    fault: Fault
    age: float
    cycles: int
    longest_cycle: float


class UrDriver:
    """The robot, as seen from the process that plans.

    Args:
        config: How to reach it.
        command_period: Time from command to command, s.

    Raises:
        InputError: If a value is impossible, or ur_rtde is not installed.
    """

    def __init__(self, config: UrDriverConfig, command_period: float) -> None:
        config.validate()
        try:
            import rtde_control  # noqa: F401
        except ImportError:
            raise InputError(
                "a UR robot needs ur_rtde: "
                'pip install -c constraints.txt -e ".[hardware]".'
            ) from None
        self._config = config
        self._commands = SharedVector(_COMMAND_SIZE)
        self._measurements = SharedVector(_MEASUREMENT_SIZE)
        context = multiprocessing.get_context("spawn")
        self._stopping = context.Event()
        self._process = context.Process(
            target=_serve,
            args=(
                config,
                command_period,
                self._commands,
                self._measurements,
                self._stopping,
            ),
            daemon=True,
        )

    @property
    def pid(self) -> int | None:
        """Of the driver's process; None before the start."""
        return self._process.pid

    def start(self) -> None:
        """Connects, and returns once the robot has told where it is.

        Raises:
            InputError: If it does not answer in time.
        """
        self._process.start()
        deadline = time.monotonic() + self._config.connection_timeout
        while np.isnan(self.read().position).any():
            if time.monotonic() > deadline or not self._process.is_alive():
                self.stop()
                raise InputError(
                    f"ur.host: no robot answers at {self._config.host} within "
                    f"{self._config.connection_timeout:g} s."
                )
            time.sleep(0.01)

    def command(self, position: np.ndarray, engaged: bool) -> None:
        """Leaves a command for the driver's next cycle.

        Args:
            position: Of the joints, shape (6,), rad.
            engaged: Whether the arm is to follow.  The first command that says so must
                be where the arm is.
        """
        self._commands.write(np.concatenate([[float(engaged)], position]))

    def read(self) -> UrMeasurement:
        """The newest measurement; its numbers are nan before the first."""
        values, stamp = self._measurements.read()
        if np.isnan(stamp):  # Nothing has come yet.
            nan = np.full(NUM_JOINTS, np.nan)
            return UrMeasurement(nan, nan, Fault.NONE, np.inf, 0, 0.0)
        position, velocity, rest = np.split(values, [NUM_JOINTS, 2 * NUM_JOINTS])
        heard_at, fault, cycles, longest_cycle = rest.tolist()
        age = time.monotonic() - heard_at
        return UrMeasurement(
            position, velocity, Fault(int(fault)), age, int(cycles), longest_cycle
        )

    def stop(self) -> None:
        """Stops the arm, if it moves, and ends the driver."""
        self._stopping.set()
        if self._process.pid is not None:
            self._process.join(timeout=2.0)
            if self._process.is_alive():
                # The watchdog stops the arm.
                self._process.kill()
                self._process.join()


def _serve(
    config: UrDriverConfig,
    command_period: float,
    commands: SharedVector,
    measurements: SharedVector,
    stopping: Event,
) -> None:
    """The driver's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        wait([parent.sentinel])
        stopping.set()

    Thread(target=follow, daemon=True).start()
    _Stream(config, command_period, commands, measurements).run(stopping.is_set)
    # The library's threads may hang on a dead connection.
    os._exit(0)


class _Stream:
    """The driver's loop: measure, check, command."""

    def __init__(
        self,
        config: UrDriverConfig,
        command_period: float,
        commands: SharedVector,
        measurements: SharedVector,
    ) -> None:
        self._config = config
        self._command_period = command_period
        self._commands = commands
        self._measurements = measurements
        self._fault = Fault.NONE
        self._receive: Any = None
        self._control: Any = None
        self._period = command_period
        # The newest command that was accepted, and the one before it, shape (6,); when
        # it was, and when it was written.  None until the arm is engaged.
        self._accepted: np.ndarray | None = None
        self._before: np.ndarray | None = None
        self._accepted_at = np.nan
        self._stamp = np.nan
        self._cycles = 0
        self._longest_cycle = 0.0
        self._sent_at = np.nan

    def run(self, stopping: Callable[[], bool]) -> None:
        """Until told to stop; the first measurement tells that it is connected."""
        try:
            self._connect()
        except (RuntimeError, ValueError):
            # Nobody answers: whoever waits for a measurement says so.
            return
        timestamp, heard_at = np.nan, time.monotonic()
        cycle = time.monotonic()
        position = velocity = np.full(NUM_JOINTS, np.nan)
        while not stopping():
            now = time.monotonic()
            fault = Fault.NONE
            try:
                if self._receive.getTimestamp() != timestamp:
                    timestamp, heard_at = self._receive.getTimestamp(), now
                position = np.array(self._receive.getActualQ())
                velocity = np.array(self._receive.getActualQd())
                fault = self._check_robot(now - heard_at)
                if fault == self._fault == Fault.NONE:
                    fault = self._follow(position, now)
            except (RuntimeError, ValueError):
                # What the library throws when it has lost the robot.
                fault = Fault.CONNECTION_LOST
            new_fault = fault != self._fault == Fault.NONE
            if new_fault:
                self._fault = fault
            if self._config.dry_run and self._accepted is not None:
                position = self._accepted
            # A frozen stream looks old, whatever is read from it.
            rest = [heard_at, self._fault, self._cycles, self._longest_cycle]
            self._measurements.write(np.concatenate([position, velocity, rest]))
            if self._fault == Fault.CONNECTION_LOST:
                # The library would connect anew and upload its program again and again.
                return
            # After it was told: to stop takes a while.
            if new_fault and fault in _OURS:
                self._brake()
            # Late once, it is not early afterwards.
            cycle = max(cycle + self._period, time.monotonic())
            time.sleep(max(0.0, cycle - time.monotonic()))
        if self._fault == Fault.NONE:
            self._brake()

    def _connect(self) -> None:
        from rtde_control import RTDEControlInterface
        from rtde_receive import RTDEReceiveInterface

        host = self._config.host
        self._receive = RTDEReceiveInterface(host, -1.0, _VARIABLES)
        if not self._config.dry_run:
            self._control = RTDEControlInterface(host)
            self._control.setWatchdog(_WATCHDOG_FREQUENCY)
            # 0 from a CB3, to which ur_rtde does not send that question.
            self._period = self._control.getStepTime() or _CB3_PERIOD

    def _check_robot(self, age: float) -> Fault:
        """What the robot says of itself, or that it says nothing."""
        receive = self._receive
        if not receive.isConnected():
            return Fault.CONNECTION_LOST
        if age > self._config.command_timeout:
            return Fault.STALE_MEASUREMENT
        safety = receive.getSafetyMode()
        if safety in _SAFETY_PROTECTIVE:
            return Fault.PROTECTIVE_STOP
        if safety not in _SAFETY_NORMAL:
            return Fault.EMERGENCY_STOP
        program_runs = (
            self._control is None or receive.getRuntimeState() == _PROGRAM_RUNNING
        )
        if receive.getRobotMode() != _ROBOT_RUNNING or not program_runs:
            return Fault.NOT_RUNNING
        return Fault.NONE

    def _follow(self, measured: np.ndarray, now: float) -> Fault:
        """Takes the newest command, if it is safe, and goes there."""
        values, stamp = self._commands.read()
        if np.isnan(stamp) or not values[0]:
            # Not engaged; the controller waits for a sign of life all the same.
            if self._control is not None:
                self._control.kickWatchdog()
            return Fault.NONE
        if stamp != self._stamp:
            fault = self._accept(values[1:], measured, now)
            if fault != Fault.NONE:
                return fault
            self._stamp = stamp
        assert self._accepted is not None
        assert self._before is not None
        moving = (self._accepted != self._before).any()
        limit = self._config.command_timeout if moving else self._config.patience
        if now - stamp > limit:
            return Fault.STALE_COMMAND
        return self._send(now)

    def _accept(self, desired: np.ndarray, measured: np.ndarray, now: float) -> Fault:
        """Checks a new command and makes it the one to follow."""
        first = self._accepted is None
        # The first command has to be where the arm is.
        accepted = measured if self._accepted is None else self._accepted
        elapsed = 0.0 if first else now - self._accepted_at
        fault = check_command(
            self._config.limits,
            # The commands' clock and this one may be a command apart.
            elapsed + self._command_period,
            desired,
            accepted,
            accepted if self._config.dry_run else measured,
        )
        if fault == Fault.NONE:
            self._before, self._accepted = (desired if first else accepted), desired
            self._accepted_at = now
        return fault

    def _send(self, now: float) -> Fault:
        """Sends where the arm is to be by now, between the last two commands."""
        assert self._accepted is not None
        assert self._before is not None
        if not np.isnan(self._sent_at):
            self._longest_cycle = max(self._longest_cycle, now - self._sent_at)
        self._sent_at = now
        self._cycles += 1
        if self._control is None:
            return Fault.NONE
        # A controller that is faster than the commands gets a straight line.
        share = (now - self._accepted_at + self._period) / self._command_period
        position = self._before + min(share, 1.0) * (self._accepted - self._before)
        taken = self._control.servoJ(
            position.tolist(),
            _UNUSED,
            _UNUSED,
            self._period,
            self._config.lookahead_time,
            self._config.gain,
        )
        return Fault.NONE if taken else Fault.NOT_RUNNING

    def _brake(self) -> None:
        """Stops the arm and ends the program that could move it.

        Where the robot is not well it stops by itself: by what it does then, or by its
        watchdog, since nothing is sent any more.  The library would wait in vain.
        """
        if self._control is None:
            return
        try:
            self._control.servoStop(_DECELERATION)
            self._control.stopScript()
        except RuntimeError:
            # There is no connection left: the watchdog stops the arm.
            pass
