"""Our drivers as seen over LCM, by whoever plans elsewhere."""

import math
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.drivers.lcm_config import COMMAND_CHANNEL, POSES_CHANNEL, STATUS_CHANNEL
from rhp_drake.drivers.lcm_inbox import Inbox, SenderClock, utime
from rhp_drake.drivers.rhp_lcm import (
    lcmt_object_poses,
    lcmt_ur_command,
    lcmt_ur_status,
)
from rhp_drake.safety import Fault
from rhp_drake.station.hardware_station import Arm, Tracker
from rhp_drake.station.ports import COMMAND_PERIOD

if TYPE_CHECKING:
    from pydrake.lcm import DrakeLcmInterface


# s: so long after a planner let the arm go another may come.
_FORGET_TIME: Final = 1.0


class LcmBridge:
    """Passes commands to a robot's driver, and tells what robot and tracker measure.

    A command is passed on once, and while it is fresh: to the arm's driver a planner
    that is dead, or a network that is stuck, is no command, and the arm stops.  It is
    the arm's driver that checks commands: at a nan, too, it stops the arm.

    Args:
        lcm: The other side.
        arm: The robot's driver, which runs.
        tracker: The tracker's driver, which runs.
        objects: Names of what the tracker knows, in its order.
        max_age: How old a command may be, s.
    """

    def __init__(
        self,
        lcm: "DrakeLcmInterface",
        arm: Arm,
        tracker: Tracker,
        objects: list[str],
        max_age: float,
    ) -> None:
        self._lcm = lcm
        self._arm = arm
        self._tracker = tracker
        self._objects = objects
        self._max_age = max_age
        self._engaged = False
        self._heard_at = -math.inf
        self._due = time.monotonic()
        self._inbox = Inbox(lcm, COMMAND_CHANNEL, lcmt_ur_command, self._Take)

    def step(self) -> Fault:
        """Passes commands on for one period, and tells, once, what is measured.

        Returns:
            The arm's fault.
        """
        left = math.inf
        while left > 0:
            left = self._due - time.monotonic()
            self._lcm.HandleSubscriptions(max(0, math.ceil(1000 * left)))
        # Late once, it is not early afterwards.
        self._due = max(self._due + COMMAND_PERIOD, time.monotonic())
        if not self._engaged and time.monotonic() - self._heard_at > _FORGET_TIME:
            # Whoever is next may have another clock; but not at once, for a command
            # that was overtaken on the way must not look new.
            self._inbox.clock = SenderClock()
        self._PublishPoses()
        return self._PublishStatus()

    def _Take(self, command: lcmt_ur_command) -> None:
        self._heard_at = time.monotonic()
        age = self._heard_at - self._inbox.clock.to_ours(command.utime)
        if age > self._max_age:
            return
        self._arm.command(np.array(command.joint_position), bool(command.engaged))
        self._engaged = bool(command.engaged)

    def _PublishStatus(self) -> Fault:
        message = lcmt_ur_status()
        message.utime = utime()
        measured = self._arm.read()
        message.measured_utime = _measured_utime(message.utime, measured.age)
        message.joint_position_measured = list(measured.position)
        message.joint_velocity_estimated = list(measured.velocity)
        message.engaged = self._engaged
        message.fault = int(measured.fault)
        self._lcm.Publish(STATUS_CHANNEL, message.encode())
        return measured.fault

    def _PublishPoses(self) -> None:
        message = lcmt_object_poses()
        message.utime = utime()
        for name, pose in zip(self._objects, self._tracker.read(), strict=True):
            if math.isinf(pose.age):
                continue
            message.num_objects += 1
            message.name.append(name)
            message.measured_utime.append(_measured_utime(message.utime, pose.age))
            message.position.append(pose.X_WB.translation())
            message.quaternion.append(pose.X_WB.rotation().ToQuaternion().wxyz())
        self._lcm.Publish(POSES_CHANNEL, message.encode())


def _measured_utime(sent: int, age: float) -> int:
    """When that was measured which, just after it is `sent`, is `age` s old.

    If anything it was later.
    """
    return sent - max(0, math.ceil(age * 1e6))
