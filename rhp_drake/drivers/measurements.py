"""What drivers measure, whoever the robot and the tracker are."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rhp_drake.safety import Fault

if TYPE_CHECKING:
    from pydrake.math import RigidTransform


@dataclass(frozen=True)
class ArmMeasurement:
    """What is known of the robot.

    Attributes:
        position: Of the joints, base to wrist, shape (6,), rad.
        velocity: Likewise, rad/s.
        fault: Why the arm was stopped, if it was.
        age: Since something new was heard of it, s; on its way it may have been for as
            long again.
    """

    position: np.ndarray
    velocity: np.ndarray
    fault: Fault
    age: float


@dataclass(frozen=True)
class ObjectPose:
    """What is known of one box.

    Attributes:
        X_WB: Its pose when it was last seen; its position is nan if it never was.
        age: For how long that has been known, s; inf if it never was seen.
    """

    X_WB: "RigidTransform"
    age: float
