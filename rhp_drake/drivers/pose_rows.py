"""Poses of objects in shared memory: one row each, alike for every tracker."""

import math
from typing import Final

import numpy as np

from rhp_drake.drivers.measurements import ObjectPose

# Position (m), quaternion (w, x, y, z), when it was seen (s of time.monotonic); all nan
# if it never was.
POSE_SIZE: Final = 3 + 4 + 1
# How far from 1 a quaternion's length may be: float32 has precision 1e-7.
NORM_TOLERANCE: Final = 1e-3


def to_poses(rows: np.ndarray, now: float) -> list[ObjectPose]:
    """What is known of each object now.

    Args:
        rows: Shape (m, POSE_SIZE).
        now: s of time.monotonic.
    """
    # Drake is imported late: the processes that write rows do without.
    from pydrake.common.eigen_geometry import Quaternion
    from pydrake.math import RigidTransform

    poses = []
    for row in rows:
        position, quaternion, seen = row[:3], row[3:7], float(row[7])
        if math.isnan(seen):
            poses.append(ObjectPose(RigidTransform(np.full(3, np.nan)), math.inf))
            continue
        rotation = Quaternion(quaternion / np.linalg.norm(quaternion))
        poses.append(ObjectPose(RigidTransform(rotation, position), now - seen))
    return poses
