"""The driver of OptiTrack: poses of boxes from Motive's NatNet stream."""

from contextlib import redirect_stdout
from dataclasses import dataclass, field
import importlib.util
import math
import multiprocessing
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
import os
import time
from typing import TYPE_CHECKING, Any, Final
import weakref

import numpy as np

from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import InputError, WorkError
from rhp_drake.workers import follow_parent

if TYPE_CHECKING:
    from pydrake.math import RigidTransform

# How long `start` waits for the names of the rigid bodies, once its process runs...
_START_TIME: Final = 5.0  # s
# ...and how long for that process to run, on a machine that may be busy.
_SPAWN_TIME: Final = 60.0  # s
# natnet sends a keep-alive at each poll, so not the shortest; a frame comes every 8 ms.
_POLL_PERIOD: Final = 0.002  # s
# A server that was restarted does not know its clients any more.
_SILENCE: Final = 1.0  # s without a new frame, after which to connect anew.
_CONNECT_TIME: Final = 1.0  # s
_RETRY_PERIOD: Final = 0.2  # s
# Ids may be given anew in Motive.  A NatNet 4 frame says when they were, but natnet 0.3
# reads that flag from the wrong bytes: it does not know the precision time stamp
# before it.
_DEFINITIONS_PERIOD: Final = 1.0  # s
# A frame this little older than the last is that one again or comes late.  One much
# older is of a server that counts anew.
_LATE_FRAMES: Final = 120
# The quaternions come as float32, of precision 1e-7.
_NORM_TOLERANCE: Final = 1e-3

# What the driver's process publishes of each rigid body, as columns...
_POSE: Final = slice(0, 7)  # Position (m) and quaternion (x, y, z, w).
_TRACKED: Final = 7  # 0 or 1, in the last frame.
_TIME: Final = 8  # s, time.monotonic: when it was last tracked.
_FRAME: Final = 9  # Number of the frame in which it was.
_NUM_COLUMNS: Final = 10
# ...before the number of malformed datagrams.


@dataclass
class PoseConfig:
    """A pose X_AB of a frame B in a frame A.

    Attributes:
        xyz: Position of B's origin in A, m.
        rpy_deg: Roll, pitch and yaw of B in A, degrees, as Drake's RollPitchYaw.
    """

    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])

    def to_transform(self) -> "RigidTransform":
        """The pose.

        Raises:
            InputError: If it is not six finite numbers.
        """
        from pydrake.math import RigidTransform, RollPitchYaw

        numbers = [*self.xyz, *self.rpy_deg]
        if not (len(self.xyz) == len(self.rpy_deg) == 3 and np.isfinite(numbers).all()):
            raise InputError(
                "a pose is three finite numbers xyz and three rpy_deg, not "
                f"{self.xyz} and {self.rpy_deg}."
            )
        return RigidTransform(RollPitchYaw(np.deg2rad(self.rpy_deg)), self.xyz)


@dataclass
class NatNetConfig:
    """Where Motive streams, and what is where.

    Frames: W is the world, at the robot's base; O is OptiTrack's, as set in Motive; R
    is a rigid body as Motive defines it; B is its box, at the box's centre.

    Attributes:
        server_address: IP address of Motive's computer.
        local_address: IP address of this computer in the same network.
        use_multicast: Whether Motive streams multicast; else unicast.
        multicast_address: Motive's multicast group; not used in unicast.
        command_port: Where Motive takes requests, UDP.
        data_port: Where multicast frames come, UDP; not used in unicast.
        bodies: Names of the rigid bodies in Motive, in the task's order of objects.
        X_WO: Pose of O in W: the calibration of the cameras to the robot.
        X_RB: Pose of the box in its rigid body, by name; identity where not given.
    """

    server_address: str = "127.0.0.1"
    local_address: str = "127.0.0.1"
    use_multicast: bool = False
    # The address and the ports are Motive's defaults.
    multicast_address: str = "239.255.42.99"
    command_port: int = 1510
    data_port: int = 1511
    bodies: list[str] = field(default_factory=list)
    X_WO: PoseConfig = field(default_factory=PoseConfig)
    X_RB: dict[str, PoseConfig] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackedPose:
    """What is known of one box.

    Attributes:
        X_WB: Its pose in the last frame in which it was tracked; its position is nan
            if it never was.
        age: For how long that has been known, s; inf if it never was tracked.  It also
            grows when no frames come.
        tracked: Whether it was tracked in the last frame that came.
        frame: Motive's number of the frame that X_WB is of; -1 if there is none.
    """

    X_WB: "RigidTransform"
    age: float
    tracked: bool
    frame: int


class NatNetDriver:
    """Receives the poses of boxes from Motive, in a process of its own.

    The process survives malformed datagrams and silence, and connects anew when
    Motive is restarted.  It ends with `stop`, with this object, or with the process
    that started it.

    Args:
        config: Where and what.

    Raises:
        InputError: If `config` names no bodies or one twice, or a pose of X_WO and
            X_RB is none, or is for a body that is not named.
    """

    def __init__(self, config: NatNetConfig) -> None:
        names = config.bodies
        if not names or len(set(names)) < len(names):
            raise InputError(
                f"the NatNet driver needs different names of rigid bodies, not {names}."
            )
        unknown = sorted(config.X_RB.keys() - set(names))
        if unknown:
            raise InputError(
                f"X_RB has a pose for {_listed(unknown)}, but the rigid bodies are "
                f"{_listed(names)}."
            )
        self._config = config
        self._X_WO = config.X_WO.to_transform()
        self._X_RB = [config.X_RB.get(x, PoseConfig()).to_transform() for x in names]
        self._vector = SharedVector(len(names) * _NUM_COLUMNS + 1)
        self._end: weakref.finalize | None = None

    def start(self) -> None:
        """Starts to receive, and waits until Motive has named its rigid bodies.

        Raises:
            InputError: If Motive does not have one that is wanted, or natnet is not
                installed.
            WorkError: If Motive does not answer within seconds.
            RuntimeError: If the driver is running.
        """
        if self._end is not None:
            raise RuntimeError("the NatNet driver is running.")
        if importlib.util.find_spec("natnet") is None:
            raise InputError(
                "OptiTrack needs natnet: pip install -c constraints.txt "
                '-e ".[hardware]".'
            )
        # Drake and torch start threads, which a forked child would inherit broken.
        context = multiprocessing.get_context("spawn")
        answer, sender = context.Pipe(duplex=False)
        process = context.Process(
            target=_receive,
            args=(self._config, self._vector, sender),
            name="natnet",
            daemon=True,
        )
        process.start()
        self._end = weakref.finalize(self, _kill, process)
        sender.close()  # Else the pipe does not end with the process.
        try:
            _check_answer(answer)
        except BaseException:  # Ctrl-C, too.
            self.stop()
            raise

    def stop(self) -> None:
        """Ends the process, if it runs; `read` returns what it left."""
        if self._end is not None:
            self._end()
            self._end = None

    def read(self) -> list[TrackedPose]:
        """What is known of each box now, in the order of `bodies`; does not wait."""
        rows = self._vector.read()[0][:-1].reshape(-1, _NUM_COLUMNS)
        now = time.monotonic()
        return [
            self._Convert(row, X_RB, now)
            for row, X_RB in zip(rows, self._X_RB, strict=True)
        ]

    @property
    def num_malformed(self) -> int:
        """How many datagrams could not be read since `start`."""
        count = self._vector.read()[0][-1]
        return int(count) if math.isfinite(count) else 0

    def _Convert(
        self, row: np.ndarray, X_RB: "RigidTransform", now: float
    ) -> TrackedPose:
        # Drake is imported late: the driver's process does without.
        from pydrake.common.eigen_geometry import Quaternion
        from pydrake.math import RigidTransform

        if math.isnan(row[_TIME]):
            nowhere = RigidTransform(np.full(3, np.nan))
            return TrackedPose(nowhere, age=math.inf, tracked=False, frame=-1)
        x, y, z, qx, qy, qz, qw = row[_POSE]
        X_OR = RigidTransform(Quaternion(w=qw, x=qx, y=qy, z=qz), [x, y, z])
        return TrackedPose(
            X_WB=self._X_WO @ X_OR @ X_RB,
            age=float(now - row[_TIME]),
            tracked=bool(row[_TRACKED]),
            frame=int(row[_FRAME]),
        )


def _listed(names: list[str]) -> str:
    return ", ".join(map(repr, names))


def _check_answer(answer: Connection) -> None:
    """Waits for what the driver's process says of its start, and raises that."""
    with answer:
        try:
            if not answer.poll(_SPAWN_TIME + _START_TIME):
                raise WorkError("the NatNet driver's process does not start.")
            error = answer.recv()
        except EOFError:
            raise WorkError("the NatNet driver's process died at its start.") from None
    if error is not None:
        raise error


def _kill(process: BaseProcess) -> None:
    """Ends a process that has nothing to save, and waits until it has ended."""
    process.kill()
    process.join()


def _make_natnet_doubt_counts() -> None:
    """Makes natnet raise an error where a datagram counts more than it contains.

    natnet 0.3 would take gigabytes, or minutes, before it finds out.
    """
    from natnet import nat_net_client

    class BoundedBuffer(nat_net_client.PacketBuffer):
        def read_float32_array(self, count: int) -> tuple[float, ...]:
            if self.pointer + 4 * count > len(self.data):
                raise ValueError(f"no {count} numbers are left")
            return super().read_float32_array(count)

        def read_string(self, *args: Any, **kwargs: Any) -> str:
            if self.pointer >= len(self.data):
                raise ValueError("no text is left")
            return super().read_string(*args, **kwargs)

    nat_net_client.PacketBuffer = BoundedBuffer


def _receive(config: NatNetConfig, vector: SharedVector, answer: Connection) -> None:
    """What the driver's process does, until it is killed."""
    follow_parent()
    _make_natnet_doubt_counts()
    # natnet prints a line for each odd datagram.
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        _Receiver(config, vector, answer).run()


class _Receiver:
    """The side of the driver that has the sockets.

    Args:
        config: Where and what.
        vector: Where to publish.
        answer: Where to send, once, whether the start went well: None or an error.
    """

    def __init__(
        self, config: NatNetConfig, vector: SharedVector, answer: Connection
    ) -> None:
        self._config = config
        self._vector = vector
        self._answer: Connection | None = answer
        self._rows = np.full((len(config.bodies), _NUM_COLUMNS), np.nan)
        self._num_malformed = 0
        self._row_of_id: dict[int, int] = {}
        self._last_number = -math.inf
        # What natnet has received and nobody has looked at.
        self._frames: list[Any] = []
        self._definitions: list[Any] = []

    def run(self) -> None:
        """Connects, again and again."""
        from natnet import NatNetClient

        config = self._config
        give_up_at = time.monotonic() + _START_TIME
        self._Publish()
        while True:
            # A new one: an old one remembers much of the server before.
            client = NatNetClient(
                server_ip_address=config.server_address,
                local_ip_address=config.local_address,
                multicast_address=config.multicast_address,
                command_port=config.command_port,
                data_port=config.data_port,
                use_multicast=config.use_multicast,
            )
            client.on_data_frame_received_event.handlers.append(self._frames.append)
            client.on_data_description_received_event.handlers.append(
                self._definitions.append
            )
            problem = "it sends neither frames nor names"
            try:
                client.connect(_CONNECT_TIME)
                self._ReceiveFrom(client)
            except TimeoutError:
                problem = "nobody answers"
            except Exception as error:
                # Of many kinds: no such address, no network, a malformed answer.
                problem = str(getattr(error, "inner_error", error))
                time.sleep(_RETRY_PERIOD)
            finally:
                client.shutdown()
            if time.monotonic() > give_up_at:
                where = f"{config.server_address}:{config.command_port}"
                self._Answer(WorkError(f"no NatNet server at {where}: {problem}."))

    def _ReceiveFrom(self, client: Any) -> None:
        """Publishes what comes, until no new frame has come for `_SILENCE`.

        Raises:
            OSError: If there is no network.
        """
        # This server may count its bodies in another order than the one before.
        self._row_of_id = {}
        ask_at = -math.inf
        # When the sockets were last known to be empty.  What they hold came later, if
        # only just: an age is never understated, even if this process was not run for
        # a while.
        heard = emptied = time.monotonic()
        while (now := time.monotonic()) - heard < _SILENCE:
            if now >= ask_at:
                client.request_modeldef()
                ask_at = now + _DEFINITIONS_PERIOD
            try:
                client.update_sync()
                emptied_next = now
            except OSError:
                raise
            except Exception:
                # Of many kinds, by what is malformed; the next update goes on after it.
                self._num_malformed += 1
                emptied_next = emptied
                self._Publish()
            while self._definitions:
                self._TakeDefinitions(self._definitions.pop(0))
            while self._frames:
                if self._TakeFrame(self._frames.pop(0), received=emptied):
                    heard = now
                    self._Publish()
            emptied = emptied_next
            time.sleep(_POLL_PERIOD)

    def _TakeDefinitions(self, definitions: Any) -> None:
        """Learns which id each wanted body has."""
        names = self._config.bodies
        ids = {body.name: body.id_num for body in definitions.rigid_bodies}
        self._row_of_id = {
            ids[name]: row for row, name in enumerate(names) if name in ids
        }
        missing = [name for name in names if name not in ids]
        self._Answer(
            InputError(
                f"Motive has no rigid body {_listed(missing)}; it has "
                f"{_listed(list(ids)) or 'none'}."
            )
            if missing
            else None
        )

    def _TakeFrame(self, frame: Any, received: float) -> bool:
        """Notes the poses in a frame, unless it is not new, and says whether it is.

        Args:
            frame: A natnet.DataFrame.
            received: When, s of time.monotonic.
        """
        number = frame.prefix.frame_number
        if self._last_number - _LATE_FRAMES < number <= self._last_number:
            return False
        self._last_number = number
        self._rows[:, _TRACKED] = 0
        for body in frame.rigid_bodies:
            row = self._row_of_id.get(body.id_num)
            pose = np.array([*body.pos, *body.rot])
            norm = np.linalg.norm(pose[3:])
            if (
                row is not None
                and body.tracking_valid
                and np.isfinite(pose).all()
                and abs(norm - 1) <= _NORM_TOLERANCE
            ):
                pose[3:] /= norm
                self._rows[row] = [*pose, 1, received, number]
        return True

    def _Publish(self) -> None:
        self._vector.write(np.append(self._rows, self._num_malformed))

    def _Answer(self, error: Exception | None) -> None:
        """Says how the start went, unless that has been said; the parent ends it."""
        if self._answer is not None:
            self._answer.send(error)
            self._answer.close()
            self._answer = None
