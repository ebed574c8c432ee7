"""A robot and a tracker over LCM, for a lab whose driver is a process of its own.

`lcm_receiver` is what receives.  Messages and channels are in docs/hardware.md.
"""

import math
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.drivers.lcm_config import (
    COMMAND_CHANNEL,
    POSES_CHANNEL,
    STATUS_CHANNEL,
    LcmConfig,
)
from rhp_drake.drivers.lcm_inbox import utime
from rhp_drake.drivers.lcm_receiver import STATUS_SIZE, receive
from rhp_drake.drivers.measurements import ArmMeasurement, ObjectPose
from rhp_drake.drivers.pose_rows import POSE_SIZE, to_poses
from rhp_drake.drivers.receiver_process import ReceiverProcess
from rhp_drake.drivers.rhp_lcm import lcmt_ur_command
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import WorkError
from rhp_drake.safety import NUM_JOINTS, Fault, describe, to_fault

if TYPE_CHECKING:
    from pydrake.lcm import DrakeLcmInterface

# How long `start` waits for its process, and the first status and poses.
_START_TIME: Final = 10.0  # s
# How often it says that the arm is to follow no more: a datagram may be lost, or find
# another in the other side's queue.
_LET_GO_TIMES: Final = 3


class LcmArm:
    """The robot: sends commands, and reads its status from shared memory.

    Args:
        lcm: Where to send.
        status: What a `Receiver` writes.
        command_period: Time from command to command, s.
    """

    def __init__(
        self, lcm: "DrakeLcmInterface", status: SharedVector, command_period: float
    ) -> None:
        self._lcm = lcm
        self._status = status
        self._command_period = command_period
        self._engaged = False

    def command(self, position: np.ndarray, engaged: bool) -> None:
        """Sends a command, and does not wait for anything.

        Args:
            position: Of the joints, shape (6,), rad.
            engaged: Whether the arm is to follow.
        """
        message = lcmt_ur_command()
        message.utime = utime()
        message.engaged = engaged
        message.joint_position = list(position)
        self._lcm.Publish(COMMAND_CHANNEL, message.encode())
        self._engaged = engaged

    def let_go(self) -> None:
        """Says that the arm is to follow no more, if it does; takes a few periods."""
        if not self._engaged:
            return
        for _ in range(_LET_GO_TIMES):
            self.command(np.full(NUM_JOINTS, np.nan), engaged=False)
            time.sleep(self._command_period)

    def read(self) -> ArmMeasurement:
        """The newest measurement; its numbers are nan before the first.

        A fault that is none of ours is `Fault.NOT_RUNNING`.
        """
        values, stamp = self._status.read()
        if math.isnan(stamp):
            nan = np.full(NUM_JOINTS, np.nan)
            return ArmMeasurement(nan, nan, Fault.NONE, math.inf)
        position, velocity, (_, fault, measured) = np.split(
            values, [NUM_JOINTS, 2 * NUM_JOINTS]
        )
        return ArmMeasurement(
            position,
            velocity,
            to_fault(fault),
            time.monotonic() - measured,
        )

    def is_commanded(self) -> bool:
        """Whether the driver says that somebody, we or another, commands the arm."""
        values, _ = self._status.read()
        return values[2 * NUM_JOINTS] == 1


class LcmTracker:
    """The tracker: reads poses from shared memory.

    Args:
        poses: What a `Receiver` writes.
    """

    def __init__(self, poses: SharedVector) -> None:
        self._poses = poses

    def read(self) -> list[ObjectPose]:
        """What is known of each object now, in the order of `LcmConfig.objects`."""
        rows = self._poses.read()[0].reshape(-1, POSE_SIZE)
        return to_poses(rows, time.monotonic())


class LcmDriver:
    """Talks to a driver over LCM, and receives in a process of its own.

    The process survives malformed messages and silence.  It ends with `stop`, with this
    object, or with the process that started it.

    Args:
        config: Where, and the names of the objects.
        command_period: Time from command to command, s.

    Raises:
        InputError: If `config` is impossible.
    """

    def __init__(self, config: LcmConfig, command_period: float) -> None:
        from pydrake.lcm import DrakeLcm, DrakeLcmParams

        config.validate()
        self._config = config
        self._status = SharedVector(STATUS_SIZE)
        self._poses = SharedVector(len(config.objects) * POSE_SIZE)
        # Deferred: what only sends needs no thread that receives.
        params = DrakeLcmParams(lcm_url=config.url, defer_initialization=True)
        self.arm = LcmArm(DrakeLcm(params), self._status, command_period)
        self.tracker = LcmTracker(self._poses)
        self._process = ReceiverProcess("LCM", receive)

    def start(self) -> None:
        """Starts to receive, and waits until robot and objects have been heard of.

        Raises:
            WorkError: If the driver says nothing, has not seen an object, has a
                fault, or is commanded by another program.
            RuntimeError: If the driver is running.
        """
        self._process.start((self._config, self._status, self._poses), self._WaitForAll)

    def stop(self) -> None:
        """Lets the arm go, and ends the process, if it runs."""
        try:
            self.arm.let_go()
        finally:
            self._process.stop()

    def _WaitForAll(self) -> None:
        give_up_at = time.monotonic() + _START_TIME
        while missing := self._find_missing():
            if time.monotonic() > give_up_at:
                raise WorkError(
                    f"no {missing} at {self._config.url} within {_START_TIME:g} s; "
                    "does the driver run?"
                )
            time.sleep(0.01)
        fault = self.arm.read().fault
        if fault != Fault.NONE:
            raise WorkError(
                f"the driver has stopped the arm and has to be started anew: "
                f"{describe(fault)}"
            )
        # One that was killed engages no longer than the driver's patience; then there
        # is a fault.
        if self.arm.is_commanded():
            raise WorkError("another program commands the arm.")

    def _find_missing(self) -> str:
        """What has not been heard of, in words; empty if all has."""
        if math.isinf(self.arm.read().age):
            return STATUS_CHANNEL
        unseen = [
            name
            for name, pose in zip(
                self._config.objects, self.tracker.read(), strict=True
            )
            if math.isinf(pose.age)
        ]
        return f"{POSES_CHANNEL} of {', '.join(unseen)}" if unseen else ""
