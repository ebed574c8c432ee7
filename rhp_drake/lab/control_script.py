"""The program that ur_rtde has a controller play, and how commands come to it.

The program takes commands from input registers, one look every `COMMAND_PERIOD`:

* input_int_register_0 is the command, input_double_register_0.. are its arguments;
* output_int_register_0 says 1, ready for a command, or 2, done with it.  After that the
  client has to write command 0 before another is taken;
* servoJ and speedJ are taken at every look.  They leave a target to a thread of the
  program, which goes on with it until servoStop or speedStop, come new ones or not.

The numbers of the commands and the layout of their arguments are those of ur_rtde's
`rtde_control.script`, version 1.6.5, without its offset for upper registers.
"""

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Final

import numpy as np

from rhp_drake.lab.motions import Motion, Move, Servo, Speed, Stop, ToolStop
from rhp_drake.lab.rtde_packets import Value
from rhp_drake.station.ports import NUM_JOINTS

# Data sheet of the UR5: +-360 degrees.  A little more is rounding.
POSITION_LIMIT: Final = 2 * math.pi + 1e-9  # rad, either way.
# No source says what a real controller makes of a target far from the arm.  This is far
# beyond what a client that streams positions asks for, even when some get lost.
JUMP_LIMIT: Final = 0.5  # rad between the measured position and a target of servoJ.

COMMAND_REGISTER: Final = "input_int_register_0"
_ASYNC_REGISTER: Final = "input_int_register_1"
_STATE_REGISTER: Final = "output_int_register_0"
_PROGRESS_REGISTER: Final = "output_int_register_2"
_READY: Final = 1
_DONE: Final = 2

_NAMES: Final = {
    0: "none",
    1: "moveJ",
    8: "zeroFtSensor",
    9: "speedJ",
    11: "servoJ",
    15: "speedStop",
    16: "servoStop",
    17: "setPayload",
    26: "getStepTime",
    29: "setTcp",
    31: "protectiveStop",
    33: "stopL",
    34: "stopJ",
    35: "setWatchdog",
    65: "setTargetPayload",
    255: "stopScript",
}
_ARGUMENT_REGISTERS: Final = tuple(f"input_double_register_{i}" for i in range(11))
# Taken at every look; the others once.
_CONTINUOUS: Final = {"servoJ", "speedJ", "getStepTime"}
# Nothing that is simulated depends on them.  getStepTime is for newer robots: on a CB3
# it leaves the register that it is read from as it is.
_WITHOUT_EFFECT: Final = {
    "zeroFtSensor",
    "setPayload",
    "getStepTime",
    "setTcp",
    "setTargetPayload",
}


class ProtectiveStop(Exception):  # noqa: N818
    """The controller has to stop the robot; the message says why."""


class ProgramEnd(Exception):  # noqa: N818
    """The program ends, in order or because of an error; the message says why."""


@dataclass(frozen=True)
class Command:
    """A command that the program has taken.

    Attributes:
        time: When, s.
        name: As ur_rtde's method is called.
        arguments: input_double_register_0 to 10; the command may not need them all.
    """

    time: float
    name: str
    arguments: tuple[float, ...]


class ControlScript:
    """The program while it is played.

    Attributes:
        motion: What the arm is to do; None is to stay.

    Args:
        time: Now, s.
        registers: Of output, by name; the program writes to them.
    """

    def __init__(self, time: float, registers: dict[str, int]) -> None:
        self.motion: Motion | None = None
        self._registers = registers
        # Longest time between two updates of the command, s; when the last one was.
        self._watchdog = math.inf
        self._heard_at = time
        # Which thread moves the arm, "servo", "speed", "move" or "stop", and whether
        # the main one does and waits until it is done.
        self._thread = ""
        self._waiting = False
        self._executing = False
        # Motions of the threads "move" and "stop" that were begun, and what was told
        # of them.
        self._operations = 0
        self._reports = 0
        self._report(running=False)
        self._registers[_STATE_REGISTER] = _READY

    def resume(self, time: float) -> None:
        """The program goes on after a pause; `time` is now, s."""
        self._heard_at = time

    def look(
        self,
        time: float,
        inputs: Mapping[str, Value],
        updated: bool,
        measured: np.ndarray,
    ) -> Command | None:
        """One period of the program.

        Args:
            time: Now, s.
            inputs: All registers of input that clients ever wrote, by name.
            updated: Whether the command's was since the last period, if only to the
                same value.
            measured: Position of the joints, shape (6,), rad.

        Returns:
            The command that was taken, if a new one was.

        Raises:
            ProtectiveStop: If a command is dangerous.
            ProgramEnd: If the program ends.
        """
        if updated:
            self._heard_at = time
        elif time - self._heard_at > self._watchdog:
            raise ProgramEnd("the watchdog's input was not updated in time")
        if self._waiting:
            return None
        number = int(_number(inputs, COMMAND_REGISTER))
        name = _NAMES.get(number, str(number))
        if name == "none":
            self._executing = False
            self._registers[_STATE_REGISTER] = _READY
            return None
        continuous = name in _CONTINUOUS
        if self._executing and not continuous:
            return None
        command = Command(
            time,
            name,
            tuple(_number(inputs, register) for register in _ARGUMENT_REGISTERS),
        )
        self._executing = self._executing or not continuous
        self._take(command, _number(inputs, _ASYNC_REGISTER) == 1, measured)
        if not self._waiting:
            self._registers[_STATE_REGISTER] = _READY if continuous else _DONE
        return command if updated or not continuous else None

    def _take(self, command: Command, alone: bool, measured: np.ndarray) -> None:
        """Does what a command says; `alone` if the client does not wait for it."""
        name, reals = command.name, command.arguments
        target = np.array(reals[:NUM_JOINTS])
        match name:
            case "servoJ":
                self._take_over("servo")
                _check_servo(target, reals[9], measured)
                self.motion = Servo(target, reals[9])
            case "speedJ":
                self._take_over("speed")
                _check(target, reals[6])
                self.motion = Speed(target, reals[6])
            case "moveJ":
                self._end_thread("move")
                _check(target, reals[6], reals[7])
                self._begin(Move(target, reals[6], reals[7]), "move" if alone else "")
            case "servoStop" | "speedStop":
                self._end_thread("servo", "speed")
                _check((), reals[0])
                self._begin(ToolStop(reals[0]), "")
            case "stopJ" | "stopL":
                self._end_thread("move", "stop")
                _check((), reals[0])
                kind = Stop if name == "stopJ" else ToolStop
                self._begin(kind(reals[0]), "stop" if alone else "")
            case "setWatchdog":
                _check((), reals[0])
                self._watchdog, self._heard_at = 1 / reals[0], command.time
            case "protectiveStop":
                raise ProtectiveStop("the program asked for it")
            case "stopScript":
                raise ProgramEnd("the client stopped it")
            case _ if name not in _WITHOUT_EFFECT:
                # Better than to do as if.
                raise ProgramEnd(f"command {name} is not simulated")

    def finish(self) -> None:
        """The motion is done: what waits for it goes on."""
        if self._waiting:
            self.motion, self._waiting = None, False
            self._registers[_STATE_REGISTER] = _DONE
        else:
            self._end_thread("move", "stop")

    def _begin(self, motion: Motion, thread: str) -> None:
        self._take_over(thread)
        self.motion = motion
        self._waiting = not thread
        if thread:
            self._operations += 1
            self._report(running=True)

    def _take_over(self, thread: str) -> None:
        """Lets a thread, "" for the main one, move the arm, if no other does."""
        if self._thread not in ("", thread):
            raise ProgramEnd("another thread is already controlling the robot")
        self._thread = thread

    def _end_thread(self, *names: str) -> None:
        if self._thread in names:
            if self._thread in ("move", "stop"):
                self._report(running=False)
            self._thread, self.motion = "", None

    def _report(self, running: bool) -> None:
        """Bit 15: whether a motion runs; from bit 16 and 24, two counters of 7 bits."""
        self._reports += 1
        self._registers[_PROGRESS_REGISTER] = (
            running << 15 | self._reports % 128 << 16 | self._operations % 128 << 24
        )


def _number(inputs: Mapping[str, Value], name: str) -> float:
    value = inputs.get(name, 0.0)
    assert not isinstance(value, tuple)
    return value


def _check(arguments: np.ndarray | tuple[float, ...], *positive: float) -> None:
    """Raises unless all are finite, and the speeds and accelerations positive."""
    if not np.isfinite([*arguments, *positive]).all():
        raise ProtectiveStop("a command's arguments are not finite")
    if min(positive) <= 0:
        raise ProgramEnd("a command's speed, acceleration or time is not positive")


def _check_servo(target: np.ndarray, time: float, measured: np.ndarray) -> None:
    _check(target, time)
    if np.abs(target).max() > POSITION_LIMIT:
        raise ProtectiveStop("servoJ to a position beyond a joint's range")
    if np.abs(target - measured).max() > JUMP_LIMIT:
        raise ProtectiveStop("servoJ to a position far from the arm")
