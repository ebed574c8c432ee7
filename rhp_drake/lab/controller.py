"""What a UR5's controller does, without sockets: CB3, PolyScope 3.15."""

from collections import deque
from collections.abc import Mapping
import math
from threading import RLock
from typing import Final

import numpy as np

from rhp_drake.lab.control_script import (
    COMMAND_REGISTER,
    POSITION_LIMIT,
    Command,
    ControlScript,
    ProgramEnd,
    ProtectiveStop,
)
from rhp_drake.lab.modes import SAFETY_BITS, RobotMode, RuntimeState, SafetyMode
from rhp_drake.lab.motions import Stop
from rhp_drake.lab.rtde_packets import Value
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS

# Data sheet of the UR5: 180 degrees/s.  A little more is rounding.
SPEED_LIMIT: Final = math.pi + 1e-6  # rad/s
# No source says how far a real controller lets a joint be from where it belongs before
# it stops.  This is far beyond what an arm in order does at the speed limit.
DEVIATION_LIMIT: Final = 0.2  # rad between the measured and the commanded position.
# The program's end and all stops bring the joints to rest in 12 periods, 96 ms.
STOP_PERIODS: Final = 12
# Dashboard Server: a protective stop can be unlocked after 5 s.
UNLOCK_DELAY: Final = 5.0  # s
# An arm that was stopped because something blocks it would push on.  Like brakes, a
# stopped controller lets the command go, until it is this near to the joints.
_RELAXED: Final = 0.05  # rad
_RELAXING_SPEED: Final = 0.1  # rad/s
# Commands that are remembered: 8 s of servoJ.
_NUM_REMEMBERED: Final = 1000
# RTDE guide: modes of a joint.
_JOINT_RUNNING: Final = 253
_JOINT_OFF: Final = 239


class Controller:
    """The controller of a UR5 that is switched on, its brakes released.

    It plays one program, `ControlScript`.  It has no clock: whoever has the arm calls
    `tick` every `COMMAND_PERIOD`, and nothing happens in between.  All methods may be
    called from any thread.

    Positions that it returns are always finite.  Whatever stops the joints, they come
    to rest within `STOP_PERIODS`, and stay.

    Args:
        position: Of the joints, shape (6,), rad.

    Raises:
        ValueError: If no arm can stand there.
    """

    def __init__(self, position: np.ndarray) -> None:
        if np.shape(position) != (NUM_JOINTS,) or not np.isfinite(position).all():
            raise ValueError(f"no arm can stand at {position}")
        self._lock = RLock()
        self._time = 0.0
        # Position and velocity of the joints, shape (6,) each.
        self._measured = np.array(position, dtype=float), np.zeros(NUM_JOINTS)
        self._commanded = self._measured
        self._brake: Stop | None = None
        self._commands: deque[Command] = deque(maxlen=_NUM_REMEMBERED)
        self._boot(RobotMode.RUNNING)

    def _boot(self, robot_mode: RobotMode) -> None:
        self._robot_mode = robot_mode
        self._safety_mode = SafetyMode.NORMAL
        self._stopped_at = -math.inf
        self._stop_reason = ""
        self._script: ControlScript | None = None
        self._paused = False
        self._inputs: dict[str, Value] = {}
        self._updated: set[str] = set()
        self._registers: dict[str, int] = {}

    # What the machine that has the arm calls.

    def tick(self, time: float, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """One period of the controller.

        Args:
            time: Now, s.
            q: Measured positions of the joints, shape (6,), rad.
            qd: Measured velocities, shape (6,), rad/s.

        Returns:
            The position that the joints' servos are to follow, shape (6,), rad.
        """
        with self._lock:
            self._time = time
            self._measure(q, qd)
            script = self._playing
            if script is not None:
                self._play(script)
            self._updated.clear()
            self._move()
            return self._commanded[0].copy()

    def _measure(self, q: np.ndarray, qd: np.ndarray) -> None:
        if not (np.isfinite(q).all() and np.isfinite(qd).all()):
            self._stop(SafetyMode.FAULT, "a measurement is not finite")
            return
        self._measured = np.array(q, dtype=float), np.array(qd, dtype=float)
        deviation = np.abs(self._measured[0] - self._commanded[0]).max()
        if self._is_ready and deviation > DEVIATION_LIMIT:
            self.protective_stop("a joint is not where it was commanded to be")

    def _play(self, script: ControlScript) -> None:
        updated = COMMAND_REGISTER in self._updated
        try:
            command = script.look(self._time, self._inputs, updated, self._measured[0])
        except ProtectiveStop as stop:
            self.protective_stop(str(stop))
        except ProgramEnd as end:
            self._end_program(str(end))
        else:
            if command is not None:
                self._commands.append(command)

    def _move(self) -> None:
        """Makes the next step of what moves the arm, if anything does."""
        position, velocity = self._commanded
        script = self._playing
        if script is not None and script.motion is not None:
            state = script.motion.step(position, velocity, COMMAND_PERIOD)
            fault = self._check(state[0])
            if not fault:
                self._brake = None
                self._commanded = state
                if script.motion.done:
                    script.finish()
                return
            self.protective_stop(fault)
        if self._brake is not None:
            self._commanded = self._brake.step(position, velocity, COMMAND_PERIOD)
            if self._brake.done:
                self._brake = None
        elif not self._is_ready:
            error = self._measured[0] - position
            if np.abs(error).max() > _RELAXED:
                step = _RELAXING_SPEED * COMMAND_PERIOD
                self._commanded = position + np.clip(error, -step, step), velocity

    def _check(self, position: np.ndarray) -> str:
        """What is wrong with a position to be commanded next, shape (6,), rad."""
        if not np.isfinite(position).all():
            return "a position is not finite"
        if np.abs(position).max() > POSITION_LIMIT:
            return "a joint would leave its range"
        change = np.abs(position - self._commanded[0]).max()
        if change > SPEED_LIMIT * COMMAND_PERIOD:
            return "a joint would exceed its speed limit"
        return ""

    def _start_braking(self) -> None:
        fastest = np.abs(self._commanded[1]).max()
        self._brake = Stop(fastest / (STOP_PERIODS * COMMAND_PERIOD))

    # The program, from outside.

    def start_program(self) -> bool:
        """Plays the program from its beginning, instead of what is played.

        Returns:
            Whether it does; not if the robot is not ready.
        """
        with self._lock:
            if not self._is_ready:
                return False
            if self._script is not None:
                self._end_program("")
            self._script = ControlScript(self._time, self._registers)
            self._stop_reason = ""
            return True

    def stop_program(self) -> None:
        """Ends the program, if there is one, and stops the arm."""
        with self._lock:
            if self._script is not None:
                self._end_program("the dashboard stopped the program")

    def pause_program(self) -> bool:
        """Halts the program and the arm; False if no program is played."""
        with self._lock:
            if self._playing is None:
                return False
            self._paused = True
            self._start_braking()
            return True

    def resume_program(self) -> bool:
        """Goes on with a paused program; False if none is, or it may not."""
        with self._lock:
            if self._script is None or not self._paused or not self._is_ready:
                return False
            self._paused = False
            self._script.resume(self._time)
            return True

    def _end_program(self, reason: str) -> None:
        self._script, self._paused = None, False
        self._stop_reason = reason
        self._start_braking()

    # Safety and power.

    def protective_stop(self, reason: str = "somebody asked for it") -> None:
        """Halts arm and program, until unlocked; `reason` is for `stop_reason`."""
        with self._lock:
            self._stop(SafetyMode.PROTECTIVE_STOP, reason)

    def safeguard_stop(self) -> None:
        """Halts arm and program: somebody opens the cell's door."""
        with self._lock:
            self._stop(SafetyMode.SAFEGUARD_STOP, "the safeguard input opened")

    def emergency_stop(self) -> None:
        """Stops the arm, ends the program and cuts the power: the red button."""
        with self._lock:
            self._stop(
                SafetyMode.ROBOT_EMERGENCY_STOP, "the emergency stop was pressed"
            )

    def _stop(self, mode: SafetyMode, reason: str) -> None:
        # The worst stop is the one in force; its number is the highest.
        if mode <= self._safety_mode:
            return
        self._safety_mode = mode
        self._stopped_at = self._time
        if mode in (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP):
            self.pause_program()
        else:
            self._end_program(reason)
            self._robot_mode = RobotMode.POWER_OFF
        self._stop_reason = reason

    def unlock_protective_stop(self) -> bool:
        """Ends a protective stop; the program stays paused.

        Returns:
            Whether it is ended; not until `UNLOCK_DELAY` after it began.
        """
        with self._lock:
            if self._safety_mode == SafetyMode.PROTECTIVE_STOP:
                if self._time - self._stopped_at < UNLOCK_DELAY:
                    return False
                self._safety_mode = SafetyMode.NORMAL
            return True

    def release_safeguard_stop(self) -> None:
        """Closes the door; the program stays paused."""
        self._release(SafetyMode.SAFEGUARD_STOP)

    def release_emergency_stop(self) -> None:
        """Turns the red button back; the power stays off."""
        self._release(SafetyMode.ROBOT_EMERGENCY_STOP)

    def restart_safety(self) -> None:
        """Ends a fault; the power stays off."""
        self._release(SafetyMode.FAULT)

    def _release(self, mode: SafetyMode) -> None:
        with self._lock:
            if self._safety_mode == mode:
                self._safety_mode = SafetyMode.NORMAL

    def power_on(self) -> None:
        """Powers the arm, unless safety forbids.  Takes no time, unlike a real one."""
        with self._lock:
            normal = self._safety_mode == SafetyMode.NORMAL
            if normal and self._robot_mode == RobotMode.POWER_OFF:
                self._robot_mode = RobotMode.IDLE

    def release_brakes(self) -> None:
        """Makes the arm ready, powering it if need be, unless safety forbids."""
        with self._lock:
            self.power_on()
            if self._robot_mode == RobotMode.IDLE:
                self._robot_mode = RobotMode.RUNNING

    def power_off(self) -> None:
        """Stops arm and program and engages the brakes."""
        with self._lock:
            self._end_program("the power was switched off")
            self._robot_mode = RobotMode.POWER_OFF

    def reboot(self) -> None:
        """Switches the controller off and on: registers are empty, the arm is off."""
        with self._lock:
            self._start_braking()
            self._boot(RobotMode.POWER_OFF)

    # What clients write and read.

    def write_inputs(self, values: Mapping[str, Value]) -> None:
        """Takes a package of inputs, by the names of the RTDE guide."""
        with self._lock:
            self._inputs.update(values)
            self._updated.update(values)

    def outputs(self) -> dict[str, Value]:
        """All that is simulated, as of the last tick, by the RTDE guide's names."""
        with self._lock:
            powered = self._robot_mode != RobotMode.POWER_OFF
            playing = self._playing is not None
            joint_mode = _JOINT_RUNNING if powered else _JOINT_OFF
            return {
                "timestamp": self._time,
                "actual_q": tuple(self._measured[0].tolist()),
                "actual_qd": tuple(self._measured[1].tolist()),
                "target_q": tuple(self._commanded[0].tolist()),
                "target_qd": tuple(self._commanded[1].tolist()),
                "robot_mode": int(self._robot_mode),
                "safety_mode": int(self._safety_mode),
                "runtime_state": int(self.runtime_state),
                "robot_status_bits": int(powered) | int(playing) << 1,
                "safety_status_bits": SAFETY_BITS[self._safety_mode],
                "joint_mode": (joint_mode,) * NUM_JOINTS,
                "speed_scaling": 1.0,
                "target_speed_fraction": 1.0,
                **self._registers,
            }

    @property
    def robot_mode(self) -> RobotMode:
        """How far the robot is switched on."""
        return self._robot_mode

    @property
    def safety_mode(self) -> SafetyMode:
        """What the safety system allows."""
        return self._safety_mode

    @property
    def runtime_state(self) -> RuntimeState:
        """What the program does."""
        with self._lock:
            if self._script is None:
                return RuntimeState.STOPPED
            return RuntimeState.PAUSED if self._paused else RuntimeState.PLAYING

    @property
    def stop_reason(self) -> str:
        """Why arm or program stopped last; empty since a program started."""
        return self._stop_reason

    @property
    def commands(self) -> list[Command]:
        """The last commands of clients that the program took, oldest first."""
        with self._lock:
            return list(self._commands)

    @property
    def _playing(self) -> ControlScript | None:
        return None if self._paused else self._script

    @property
    def _is_ready(self) -> bool:
        running = self._robot_mode == RobotMode.RUNNING
        return running and self._safety_mode == SafetyMode.NORMAL
