"""The driver of OptiTrack: poses of boxes from Motive's NatNet stream.

`natnet_receiver` is what its process does.
"""

from dataclasses import replace
import importlib.util
import math
import multiprocessing
from multiprocessing.connection import Connection
import time
from typing import Final

from rhp_drake.drivers.measurements import ObjectPose
from rhp_drake.drivers.natnet_config import NatNetConfig, PoseConfig
from rhp_drake.drivers.natnet_receiver import START_TIME, receive
from rhp_drake.drivers.pose_rows import POSE_SIZE, to_poses
from rhp_drake.drivers.receiver_process import ReceiverProcess
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import InputError, WorkError

# How long `start` waits for the driver's process to run, on a machine that may be busy.
_SPAWN_TIME: Final = 60.0  # s


class NatNetDriver:
    """Receives the poses of boxes from Motive, in a process of its own.

    The process survives malformed datagrams and silence, and connects anew when
    Motive is restarted.  It ends with `stop`, with this object, or with the process
    that started it.

    Args:
        config: Where and what.

    Raises:
        InputError: If a value of `config` is impossible.
    """

    def __init__(self, config: NatNetConfig) -> None:
        config.validate()
        names = config.bodies
        self._config = config
        self._X_WO = config.X_WO.to_transform()
        self._X_RB = [config.X_RB.get(x, PoseConfig()).to_transform() for x in names]
        self._vector = SharedVector(len(names) * POSE_SIZE + 1)
        self._process = ReceiverProcess("NatNet", receive)

    def start(self) -> None:
        """Starts to receive, and waits until Motive has named its rigid bodies.

        Raises:
            InputError: If Motive does not have one that is wanted, or natnet is not
                installed.
            WorkError: If Motive does not answer within seconds.
            RuntimeError: If the driver is running.
        """
        if importlib.util.find_spec("natnet") is None:
            raise InputError(
                "OptiTrack needs natnet: pip install -c constraints.txt "
                '-e ".[hardware]".'
            )
        answer, sender = multiprocessing.Pipe(duplex=False)

        def wait() -> None:
            sender.close()  # Else the pipe does not end with the process.
            _check_answer(answer)

        self._process.start((self._config, self._vector, sender), wait)

    def stop(self) -> None:
        """Ends the process, if it runs; `read` returns what it left."""
        self._process.stop()

    def read(self) -> list[ObjectPose]:
        """What is known of each box now, in the order of `bodies`; does not wait.

        A pose is that of the last frame that tracked the box, and ages also when no
        frames come.
        """
        rows = self._vector.read()[0][:-1].reshape(-1, POSE_SIZE)
        # Motive's: X_OR rather than X_WB.
        poses = to_poses(rows, time.monotonic())
        return [
            replace(pose, X_WB=self._X_WO @ pose.X_WB @ X_RB)
            for pose, X_RB in zip(poses, self._X_RB, strict=True)
        ]

    @property
    def num_malformed(self) -> int:
        """How many datagrams could not be read since `start`."""
        count = self._vector.read()[0][-1]
        return int(count) if math.isfinite(count) else 0


def _check_answer(answer: Connection) -> None:
    """Waits for what the driver's process says of its start, and raises that."""
    with answer:
        try:
            if not answer.poll(_SPAWN_TIME + START_TIME):
                raise WorkError("the NatNet driver's process does not start.")
            error = answer.recv()
        except EOFError:
            raise WorkError("the NatNet driver's process died at its start.") from None
    if error is not None:
        raise error
