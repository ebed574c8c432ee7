"""The process of the LCM driver: what receives status and poses.

It is one of its own because `HandleSubscriptions` holds the interpreter's lock while it
waits, and because a subscription's queue keeps one message, the oldest: whoever looks
seldom sees what is old.
"""

from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.drivers.lcm_config import POSES_CHANNEL, STATUS_CHANNEL, LcmConfig
from rhp_drake.drivers.lcm_inbox import Inbox
from rhp_drake.drivers.pose_rows import NORM_TOLERANCE, POSE_SIZE
from rhp_drake.drivers.realtime import ask_for_realtime
from rhp_drake.drivers.rhp_lcm import lcmt_object_poses, lcmt_ur_status
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.safety import NUM_JOINTS
from rhp_drake.workers import follow_parent

if TYPE_CHECKING:
    from pydrake.lcm import DrakeLcmInterface

# Layout of the shared vector: q, qd, whether engaged, fault, when they were measured
# (time.monotonic).
STATUS_SIZE: Final = 2 * NUM_JOINTS + 3


def receive(config: LcmConfig, status: SharedVector, poses: SharedVector) -> None:
    """What the driver's process does, until it is killed."""
    from pydrake.lcm import DrakeLcm

    follow_parent()
    ask_for_realtime()
    lcm = DrakeLcm(config.url)
    Receiver(lcm, config.objects, status, poses)
    while True:
        lcm.HandleSubscriptions(timeout_millis=1000)


class Receiver:
    """Puts what comes over LCM into shared memory, where it ages.

    Args:
        lcm: Where it comes.
        objects: Names of those that are wanted.
        status: Gets the robot's, size STATUS_SIZE.
        poses: Gets the objects', size m * POSE_SIZE, in the order of `objects`.
    """

    def __init__(
        self,
        lcm: "DrakeLcmInterface",
        objects: list[str],
        status: SharedVector,
        poses: SharedVector,
    ) -> None:
        self._status, self._poses = status, poses
        self._rows = np.full((len(objects), POSE_SIZE), np.nan)
        self._row_of = {name: row for row, name in enumerate(objects)}
        self._status_inbox = Inbox(
            lcm, STATUS_CHANNEL, lcmt_ur_status, self._TakeStatus, _check_status
        )
        self._poses_inbox = Inbox(
            lcm, POSES_CHANNEL, lcmt_object_poses, self._TakePoses, _check_poses
        )

    def _TakeStatus(self, message: lcmt_ur_status) -> None:
        self._status.write(
            np.array(
                [
                    *message.joint_position_measured,
                    *message.joint_velocity_estimated,
                    message.engaged,
                    message.fault,
                    self._status_inbox.clock.to_ours(message.measured_utime),
                ]
            )
        )

    def _TakePoses(self, message: lcmt_object_poses) -> None:
        for name, utime, position, quaternion in zip(
            message.name,
            message.measured_utime,
            message.position,
            message.quaternion,
            strict=True,
        ):
            row = self._row_of.get(name)
            if row is not None:
                seen = self._poses_inbox.clock.to_ours(utime)
                self._rows[row] = [*position, *quaternion, seen]
        self._poses.write(self._rows.ravel())


def _check_status(message: lcmt_ur_status) -> None:
    numbers = [*message.joint_position_measured, *message.joint_velocity_estimated]
    if not np.isfinite(numbers).all():
        raise ValueError("a joint's position or velocity is not finite")
    if message.measured_utime > message.utime:
        raise ValueError("it was measured after it was sent")


def _check_poses(message: lcmt_object_poses) -> None:
    if not np.isfinite(message.position).all():
        raise ValueError("a position is not finite")
    for quaternion in message.quaternion:
        # Written so that nan is refused, too.
        if not abs(np.linalg.norm(quaternion) - 1) <= NORM_TOLERANCE:
            raise ValueError("a quaternion is not of length 1")
    if any(utime > message.utime for utime in message.measured_utime):
        raise ValueError("an object was seen after it was sent")
