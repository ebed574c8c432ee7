"""A UR robot over RTDE, in a process of its own: a long plan never starves its stream.

`ur_stream` is what that process does.  Nobody else touches a socket: commands and
measurements go through shared memory.
"""

import multiprocessing
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import Event
import sys
import time
import weakref

import numpy as np

from rhp_drake.drivers.command_periods import CommandPeriods
from rhp_drake.drivers.measurements import ArmMeasurement
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.drivers.ur_config import UrDriverConfig
from rhp_drake.drivers.ur_stream import (
    COMMAND_SIZE,
    MEASUREMENT_SIZE,
    STOP_TIME,
    serve,
)
from rhp_drake.errors import InputError
from rhp_drake.safety import NUM_JOINTS, Fault, describe


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
        self._commands = SharedVector(COMMAND_SIZE)
        self._measurements = SharedVector(MEASUREMENT_SIZE)
        self._periods = SharedVector(CommandPeriods.SIZE)
        context = multiprocessing.get_context("spawn")
        self._stopping = context.Event()
        self._problem, self._sender = context.Pipe(duplex=False)
        self._end: weakref.finalize | None = None
        self._process = context.Process(
            target=serve,
            args=(
                config,
                command_period,
                self._commands,
                self._measurements,
                self._periods,
                self._stopping,
                self._sender,
            ),
            name="ur",
            daemon=True,
        )

    @property
    def pid(self) -> int | None:
        """Of the driver's process; None before the start."""
        return self._process.pid

    def start(self) -> None:
        """Connects, and returns once the robot has told where it is.

        Raises:
            InputError: If it does not answer in time, or cannot be used.
        """
        self._process.start()
        # Also if nobody calls `stop`: the process must not outlive the shared memory.
        self._end = weakref.finalize(self, _end, self._process, self._stopping)
        self._sender.close()  # Else the pipe does not end with the process.
        deadline = time.monotonic() + self._config.connection_timeout
        try:
            while np.isnan(self.read().position).any():
                if time.monotonic() > deadline or not self._process.is_alive():
                    raise InputError(
                        f"ur.host: the robot at {self._config.host} cannot be used: "
                        f"{self._read_problem()}."
                    )
                time.sleep(0.01)
        except BaseException:
            # Nothing has moved yet, and the library may wait for the robot for long.
            self._process.kill()
            self.stop()
            raise

    def _read_problem(self) -> str:
        """What ur_rtde said, or that nothing was heard."""
        try:
            if self._problem.poll():
                return str(self._problem.recv()).rstrip("!.")
        except EOFError:
            fault = self.read().fault
            why = "" if fault == Fault.NONE else f": {describe(fault).rstrip('.')}"
            return f"its driver ended{why}"
        return f"no answer within {self._config.connection_timeout:g} s"

    def command(self, position: np.ndarray, engaged: bool) -> None:
        """Leaves a command for the driver's next cycle.

        Args:
            position: Of the joints, shape (6,), rad.
            engaged: Whether the arm is to follow.  The first command that says so must
                be where the arm is.
        """
        self._commands.write(np.concatenate([[float(engaged)], position]))

    def read(self) -> ArmMeasurement:
        """The newest measurement; its numbers are nan before the first."""
        values, stamp = self._measurements.read()
        if np.isnan(stamp):  # Nothing has come yet.
            nan = np.full(NUM_JOINTS, np.nan)
            return ArmMeasurement(nan, nan, Fault.NONE, np.inf)
        position, velocity, rest = np.split(values, [NUM_JOINTS, 2 * NUM_JOINTS])
        heard_at, fault = rest.tolist()
        age = time.monotonic() - heard_at
        if fault == Fault.NONE and not self._process.is_alive():
            fault = Fault.CONNECTION_LOST
        return ArmMeasurement(position, velocity, Fault(int(fault)), age)

    @property
    def periods(self) -> CommandPeriods:
        """The times from one position that was sent to the next, all so far."""
        values, stamp = self._periods.read()
        return CommandPeriods() if np.isnan(stamp) else CommandPeriods(values)

    def stop(self) -> None:
        """Stops the arm, if it moves, and ends the driver.  May be called again."""
        if self._end is not None:
            self._end()


def _end(process: BaseProcess, stopping: Event) -> None:
    """Ends the driver's process, in good order if it can."""
    stopping.set()
    process.join(timeout=STOP_TIME)
    if process.is_alive():
        print(
            "rhp: the robot's driver did not end and was killed; the controller's "
            "watchdog stops the arm.",
            file=sys.stderr,
        )
        process.kill()
        process.join()
