"""What a UR robot says of itself, and what of it is a fault.

The numbers are those of Universal Robots' RTDE guide.
"""

from typing import Final

import numpy as np

from rhp_drake.safety import Fault

_ROBOT_MODES: Final = range(-1, 10)
_ROBOT_RUNNING: Final = 7
_SAFETY_MODES: Final = range(1, 12)
_SAFETY_NORMAL: Final = (1, 2)  # Normal, reduced.
_SAFETY_PROTECTIVE: Final = (3, 4)  # Protective stop, recovery.
PROGRAM_RUNNING: Final = 2  # Of the runtime states.
# No joint of a UR robot turns further (360 degrees and a little), or twice as fast as
# the fastest does.
_POSSIBLE_POSITION: Final = 6.5  # rad
_POSSIBLE_VELOCITY: Final = 12.6  # rad/s


def check_robot(
    position: np.ndarray,
    velocity: np.ndarray,
    robot_mode: int,
    safety_mode: int,
    program_runs: bool,
) -> Fault:
    """Finds what is wrong with a robot that is heard of.

    Args:
        position: Of the joints, shape (6,), rad.
        velocity: Likewise, rad/s.
        robot_mode: How far it is switched on.
        safety_mode: What its safety system allows.
        program_runs: Whether its program does, or need not.
    """
    # Written so that nan is impossible, too.
    possible = (
        (np.abs(position) <= _POSSIBLE_POSITION).all()
        and (np.abs(velocity) <= _POSSIBLE_VELOCITY).all()
        and safety_mode in _SAFETY_MODES
        and robot_mode in _ROBOT_MODES
    )
    if not possible:
        return Fault.IMPLAUSIBLE_MEASUREMENT
    if safety_mode in _SAFETY_PROTECTIVE:
        return Fault.PROTECTIVE_STOP
    if safety_mode not in _SAFETY_NORMAL:
        return Fault.EMERGENCY_STOP
    if robot_mode != _ROBOT_RUNNING or not program_runs:
        return Fault.NOT_RUNNING
    return Fault.NONE
