"""From targets of the hand to joint commands: smooth straight motions."""

from dataclasses import dataclass
import math
from typing import Final

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from rhp_drake.errors import InputError
from rhp_drake.station.ports import COMMAND_PERIOD, NUM_JOINTS
from rhp_drake.station.ur5_kinematics import NOMINAL, Ur5Kinematics
from rhp_drake.systems.latching import latch_position

LINEAR_SPEED: Final = 0.12  # m/s, peak
ANGULAR_SPEED: Final = 0.6  # rad/s, peak
JOINT_SPEED: Final = 1.0  # rad/s, well below the guard's limit and the arm's pi.
BRAKE_TIME: Final = 0.1  # s, from LINEAR_SPEED that is about 2 m/s^2.
_MOTION_SIZE: Final = 9


@dataclass(frozen=True)
class _Motion:
    """A smooth motion of the hand, as a function of time since its start.

    Sum of two: what is left of the motion before brakes to a standstill, and a
    minimum-jerk motion goes straight from where that would end to the target.

    Attributes:
        start: Pose (x, y, theta), shape (3,).
        start_velocity: At the start, shape (3,), m/s and rad/s.
        target: Pose, shape (3,).
    """

    start: np.ndarray
    start_velocity: np.ndarray
    target: np.ndarray

    @property
    def stop(self) -> np.ndarray:
        """Where braking alone would end: the integral of velocity * (1 - u)^2."""
        return self.start + self.start_velocity * BRAKE_TIME / 3

    @property
    def duration(self) -> float:
        """In seconds, such that peak speeds stay below their limits."""
        x, y, theta = self.target - self.stop
        peak = 1.875  # Of the slope of the minimum-jerk profile.
        return max(
            peak * math.hypot(x, y) / LINEAR_SPEED,
            peak * abs(theta) / ANGULAR_SPEED,
            # Leaves the new motion slow while the old one brakes.
            2 * BRAKE_TIME,
        )

    def pose(self, clock: float) -> np.ndarray:
        """The pose, shape (3,), `clock` seconds after the start."""
        u = min(clock / BRAKE_TIME, 1)
        s = min(clock / self.duration, 1)
        braking = self.start_velocity * BRAKE_TIME / 3 * (1 - u) ** 3
        profile = s**3 * (10 - 15 * s + 6 * s**2)
        return self.stop - braking + (self.target - self.stop) * profile


class HandServo(LeafSystem):
    """Moves the hand to its target along a straight line, at `PUSHING_HEIGHT`.

    Position and heading follow one minimum-jerk profile, whose duration keeps the
    peak speeds within `LINEAR_SPEED` and `ANGULAR_SPEED`.  Where a joint would exceed
    `JOINT_SPEED`, the hand goes slower but stays on its path.  A new target may come
    in mid-motion: what is left of the old motion fades out within `BRAKE_TIME`.

    The command starts as the measured position and holds whenever there is no way on:
    if the target is not finite or out of reach, or if the arm would have to jump
    because it did not start at `PUSHING_HEIGHT` with the tool vertical.

    Initialization raises a RuntimeError if the measured position is not finite.
    Before initialization the command is nan.

    .. pydrake_system::

        name: HandServo
        input_ports:
        - hand_target
        - position_measured
        output_ports:
        - position

    `hand_target` has size 3: the pose (x, y, theta) of H in W, m and rad, theta
    unwrapped.  The positions have size 6 (rad).

    Args:
        kinematics: The arm's.
    """

    def __init__(self, kinematics: Ur5Kinematics = NOMINAL) -> None:
        super().__init__()
        self._kinematics = kinematics
        self._target_port = self.DeclareVectorInputPort(name="hand_target", size=3)
        self._measured_port = self.DeclareVectorInputPort(
            name="position_measured", size=NUM_JOINTS
        )
        nan = np.full(_MOTION_SIZE, np.nan)
        # The command, and the hand's pose and velocity that belong to it.
        position = self.DeclareDiscreteState(nan[:NUM_JOINTS])
        self._position = int(position)
        self._pose = int(self.DeclareDiscreteState(nan[:3]))
        self._velocity = int(self.DeclareDiscreteState(3))
        # The present `_Motion`, and how far in it the command is, in seconds.
        self._motion = int(self.DeclareDiscreteState(nan))
        self._clock = int(self.DeclareDiscreteState(1))
        self.DeclareStateOutputPort(name="position", state_index=position)
        self.DeclareInitializationDiscreteUpdateEvent(update=self._Initialize)
        self.DeclarePeriodicDiscreteUpdateEvent(
            period_sec=COMMAND_PERIOD, offset_sec=0.0, update=self._Update
        )

    def check_start(self, position: np.ndarray) -> None:
        """Raises an InputError if the hand cannot be moved from where the joints are.

        Args:
            position: Of the joints, shape (6,), rad.
        """
        upright = self._kinematics.inverse_kinematics(
            self._kinematics.hand_pose(position)
        )
        away = np.abs(upright - position).max()
        if away > JOINT_SPEED * COMMAND_PERIOD:
            raise InputError(
                "the hand does not stand upright at its pushing height: a joint is "
                f"{away:.3f} rad from where it would be.  Move the arm there first."
            )

    def _Initialize(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = latch_position(self._measured_port, context)
        discrete_state.set_value(self._position, measured)
        self._Hold(self._kinematics.hand_pose(measured), discrete_state)

    def _Hold(self, pose: np.ndarray, discrete_state: DiscreteValues) -> None:
        """Leaves the command as it is; any target then begins a motion from rest."""
        discrete_state.set_value(self._pose, pose)
        discrete_state.set_value(self._velocity, np.zeros(3))
        discrete_state.set_value(self._motion, np.full(_MOTION_SIZE, np.nan))
        discrete_state.set_value(self._clock, np.zeros(1))

    def _Update(self, context: Context, discrete_state: DiscreteValues) -> None:
        target = self._target_port.Eval(context)
        position = context.get_discrete_state(self._position).value()
        pose = context.get_discrete_state(self._pose).value()
        clock = context.get_discrete_state(self._clock).value()[0]
        motion = _Motion(
            *context.get_discrete_state(self._motion).value().reshape(3, 3)
        )
        if not np.array_equal(target, motion.target):
            velocity = context.get_discrete_state(self._velocity).value()
            motion = _Motion(start=pose, start_velocity=velocity, target=target)
            clock = 0.0
        elif clock >= motion.duration:
            discrete_state.set_value(self._velocity, np.zeros(3))
            return
        step = _next_step(motion, clock, position, self._kinematics)
        if step is None:
            self._Hold(pose, discrete_state)
            return
        next_clock, next_position = step
        next_pose = motion.pose(next_clock)
        discrete_state.set_value(self._position, next_position)
        discrete_state.set_value(self._pose, next_pose)
        discrete_state.set_value(self._velocity, (next_pose - pose) / COMMAND_PERIOD)
        discrete_state.set_value(
            self._motion,
            np.concatenate([motion.start, motion.start_velocity, motion.target]),
        )
        discrete_state.set_value(self._clock, np.array([next_clock]))


def _next_step(
    motion: _Motion, clock: float, position: np.ndarray, kinematics: Ur5Kinematics
) -> tuple[float, np.ndarray] | None:
    """Goes on along a motion for one period, or less where joints would be too fast.

    Args:
        motion: The motion, whose target may be anything.
        clock: The present time within the motion, s.
        position: The present command, shape (6,).
        kinematics: The arm's.

    Returns:
        The next time within the motion and the next command, or None if there is no
        way on.
    """
    time_step = COMMAND_PERIOD
    try:
        # Rather than go as far as possible, stay if the target is out of reach or nan.
        kinematics.inverse_kinematics(motion.target)
        # Joint speeds are almost proportional to the step: two rounds usually do.
        for _ in range(5):
            next_clock = min(clock + time_step, motion.duration)
            next_position = kinematics.inverse_kinematics(motion.pose(next_clock))
            speed = np.abs(next_position - position).max() / COMMAND_PERIOD
            if speed <= JOINT_SPEED:
                return next_clock, next_position
            time_step *= 0.98 * JOINT_SPEED / speed
    except InputError:
        pass
    return None
