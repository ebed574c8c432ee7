"""What stops the robot: limits on joint commands, and the names of faults.

The command guard in the diagram and the driver beside it check alike, so that neither
has to trust the other.  Needs NumPy alone.
"""

from dataclasses import dataclass, field
import enum
import math
from typing import Final

import numpy as np

from rhp_drake.errors import InputError

NUM_JOINTS: Final = 6
# What the arm itself can do, rad and rad/s, and half a radian, which is as good as
# lost: more would limit nothing.
_LARGEST_POSITION: Final = math.tau
_LARGEST_VELOCITY: Final = math.pi
_LARGEST_TRACKING: Final = 0.5


class Fault(enum.IntEnum):
    """Why the arm was stopped; it stays stopped until the run is started anew."""

    NONE = 0
    NOT_FINITE = 1
    POSITION_LIMIT = 2
    VELOCITY_LIMIT = 3
    TRACKING_ERROR = 4
    HAND_OUTSIDE = 5
    STALE_POSE = 6
    STALE_MEASUREMENT = 7
    STALE_COMMAND = 8
    PROTECTIVE_STOP = 9
    EMERGENCY_STOP = 10
    NOT_RUNNING = 11
    CONNECTION_LOST = 12
    OBJECT_TILTED = 13
    OBJECT_JUMPED = 14
    IMPLAUSIBLE_MEASUREMENT = 15
    LET_GO = 16


# With a limit's key: the guard's are in the scenario, under `guard`, and those of the
# driver in its own file, under `limits`.
_SENTENCES: Final = {
    Fault.NONE: "nothing is wrong.",
    Fault.NOT_FINITE: "a command, a measured joint position or an object's pose is not "
    "finite.",
    Fault.POSITION_LIMIT: "a command is beyond a joint's limit (position_limits).",
    Fault.VELOCITY_LIMIT: "a command is too far from the one before (velocity_limit).",
    Fault.TRACKING_ERROR: "a joint is too far from where it was commanded "
    "(tracking_limit).",
    Fault.HAND_OUTSIDE: "a command takes the hand out of its workspace or height.",
    Fault.STALE_POSE: "an object has not been seen for too long (object_age_limit).",
    Fault.STALE_MEASUREMENT: "the arm has not been heard of for too long.",
    Fault.STALE_COMMAND: "no command came in time.",
    Fault.PROTECTIVE_STOP: "the robot is in a protective stop.",
    Fault.EMERGENCY_STOP: "the robot's emergency or safeguard stop is on, or a safety "
    "fault.",
    Fault.NOT_RUNNING: "the robot is off, or its program does not run.",
    Fault.CONNECTION_LOST: "the connection to the robot is lost.",
    Fault.OBJECT_TILTED: "an object does not stand upright.",
    Fault.OBJECT_JUMPED: "an object is suddenly elsewhere: somebody moved it, or the "
    "tracker takes one for another.",
    Fault.IMPLAUSIBLE_MEASUREMENT: "the robot tells what cannot be.",
    Fault.LET_GO: "who commanded the arm let it go while it moved.",
}


def to_fault(number: float) -> Fault:
    """The fault of this number; of one that nobody knows, `Fault.NOT_RUNNING`."""
    # Numbers that are not whole, and nan, are nobody's either.
    return Fault(int(number)) if number in _SENTENCES else Fault.NOT_RUNNING


def describe(fault: Fault) -> str:
    """What is wrong, as half a sentence with its full stop."""
    return _SENTENCES[fault]


@dataclass
class JointLimits:
    """Limits on what is commanded to the joints.

    Attributes:
        position_limits: Largest angle of each joint, either way, rad.
        velocity_limit: Largest speed of any joint's command, rad/s.  The arm itself
            stops at pi rad/s.
        tracking_limit: Largest distance of any measured joint from its command, rad.
    """

    # The elbow turns half as far as the others.
    position_limits: list[float] = field(
        default_factory=lambda: [math.tau, math.tau, math.pi, *[math.tau] * 3]
    )
    velocity_limit: float = 1.5
    tracking_limit: float = 0.2

    def validate(self, where: str) -> None:
        """Raises an InputError if a limit is impossible, or no limit at all.

        Args:
            where: What comes before a limit's name in errors.
        """
        if len(self.position_limits) != NUM_JOINTS:
            raise InputError(
                f"{where}position_limits: {self.position_limits}; there must be "
                f"{NUM_JOINTS} positive ones."
            )
        for name, values, largest in (
            ("position_limits", self.position_limits, _LARGEST_POSITION),
            ("velocity_limit", [self.velocity_limit], _LARGEST_VELOCITY),
            ("tracking_limit", [self.tracking_limit], _LARGEST_TRACKING),
        ):
            # Written so that nan is refused, too.
            if not all(0 < value <= largest for value in values):
                raise InputError(
                    f"{where}{name}: {', '.join(map(str, values))}; it must be "
                    f"positive, and at most {largest:.2f}."
                )


def check_command(
    limits: JointLimits,
    period: float,
    desired: np.ndarray,
    accepted: np.ndarray,
    measured: np.ndarray,
) -> Fault:
    """Finds what is wrong with a joint command.

    Args:
        limits: What is allowed.
        period: Time from command to command, s.
        desired: The command, shape (6,), rad.
        accepted: The one before it, shape (6,), rad.
        measured: Where the joints are, shape (6,), rad.
    """
    if not (np.isfinite(desired).all() and np.isfinite(measured).all()):
        return Fault.NOT_FINITE
    if (np.abs(desired) > limits.position_limits).any():
        return Fault.POSITION_LIMIT
    if (np.abs(desired - accepted) > limits.velocity_limit * period).any():
        return Fault.VELOCITY_LIMIT
    # What was commanded before is what the arm can have reached by now.
    if (np.abs(accepted - measured) > limits.tracking_limit).any():
        return Fault.TRACKING_ERROR
    return Fault.NONE
