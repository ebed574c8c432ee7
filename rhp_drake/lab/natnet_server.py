"""A stand-in for Motive: streams rigid bodies over NatNet, with faults on demand."""

from collections.abc import Sequence
import enum
import heapq
import select
import socket
import struct
from threading import Event, Lock, Thread
import time
from typing import Final

import numpy as np
from pydrake.math import RigidTransform

from rhp_drake.errors import InputError

FRAME_RATE: Final = 120  # Hz, of many of OptiTrack's cameras.
_CLIENT_TIMEOUT: Final = 5.0  # s without a keep-alive, after which a client is gone.
# Motive 3.1 streams NatNet 4.1.
_APPLICATION: Final = b"Motive"
_APPLICATION_VERSION: Final = bytes([3, 1, 0, 0])
_PROTOCOL_VERSION: Final = bytes([4, 1, 0, 0])
_CLOCK_FREQUENCY: Final = 10**9  # Hz: time stamps count ns.
# Told to clients, who need them for multicast only.
_DATA_PORT: Final = 1511
_MULTICAST_ADDRESS: Final = "239.255.42.99"
_SUFFIX: Final = struct.Struct("<IIdQQQIIhi")  # Of a frame.


class _Message(enum.IntEnum):
    """The first two bytes of a datagram; two of its payload's length follow."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST_DEFINITIONS = 4
    DEFINITIONS = 5
    FRAME = 7
    KEEP_ALIVE = 10


class Freeze(enum.Enum):
    """How a stream stands still."""

    NONE = enum.auto()
    # The last frame again and again, with its number.
    REPEAT = enum.auto()
    # No frames; requests are answered.
    SILENT = enum.auto()


class NatNetServer:
    """Streams poses as Motive does, unicast, to each client that connects.

    The bodies' ids count from 1, in the order in which `set_bodies` first names them.
    The methods may be called and the attributes set from any thread at any time.

    Args:
        random: What faults draw from, in the server's thread.
        host: IP address to serve at.
        command_port: UDP port to serve at; 0 for any free one.

    Attributes:
        command_port: The UDP port it serves at.
        freeze: How the stream stands still.
        drop_share: Share of the frames that are not sent, in [0, 1].
        malformed_share: Share of the frames that are cut short, noise, or wrong about
            a length, in [0, 1].
        delay: How much later each frame is sent, s.
        jitter: Up to how much later still, s; more than a frame's period changes
            their order.
        overwritten: By name, a number that all seven of a body's pose are, though it
            is sent as tracked: nan, or 0, which is no rotation.

    Raises:
        InputError: If nobody can serve there.
    """

    def __init__(
        self,
        random: np.random.Generator,
        host: str = "127.0.0.1",
        command_port: int = 0,
    ) -> None:
        self.freeze = Freeze.NONE
        self.drop_share = 0.0
        self.malformed_share = 0.0
        self.delay = 0.0
        self.jitter = 0.0
        self.overwritten: dict[str, float] = {}

        self._random = random
        self._lock = Lock()  # Of the next four, which the methods change.
        self._poses: dict[str, np.ndarray] = {}
        self._ids: dict[str, int] = {}
        self._ids_in_frames: dict[str, int] = {}
        self._occluded: dict[str, np.ndarray] = {}

        self._clients: dict[tuple[str, int], float] = {}  # When last heard of.
        self._number = 0
        self._frame = b""
        # When to send, a count that keeps the order, and what.
        self._outbox: list[tuple[float, int, bytes]] = []
        self._stopped = Event()
        self._thread = Thread(target=self._Serve, name="natnet_server", daemon=True)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, command_port))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"no NatNet server can be at {host}:{command_port}: {error.strerror}."
            ) from None
        self.command_port: Final[int] = self._socket.getsockname()[1]

    def start(self) -> None:
        """Starts to serve."""
        self._thread.start()

    def stop(self) -> None:
        """Ends for good; clients hear nothing of it, as of a crash."""
        self._stopped.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._socket.close()

    def set_bodies(self, poses: Sequence[tuple[str, RigidTransform]]) -> None:
        """Replaces all bodies.

        Args:
            poses: Each body's name and X_OR, its pose in OptiTrack's frame.
        """
        rows = {name: _pose_row(X_OR) for name, X_OR in poses}
        with self._lock:
            self._poses = rows
            for name in rows:
                new = len(self._ids) + 1
                self._ids.setdefault(name, new)
                self._ids_in_frames.setdefault(name, new)

    def occlude(self, name: str, *, zero: bool = False) -> None:
        """Hides a body from the cameras: it is sent as not tracked.

        Args:
            name: The body's.
            zero: Whether its pose is then sent as zeros; else it stays as it is now.
        """
        with self._lock:
            pose = self._poses[name]
            self._occluded[name] = np.zeros_like(pose) if zero else pose

    def reveal(self, name: str) -> None:
        """Ends `occlude`."""
        with self._lock:
            self._occluded.pop(name, None)

    def swap(self, first: str, second: str) -> None:
        """Makes the cameras take two bodies for each other; again, and they do not."""
        with self._lock:
            ids = self._ids_in_frames
            ids[first], ids[second] = ids[second], ids[first]

    def _Serve(self) -> None:
        """What the server's thread does."""
        due = time.monotonic()
        while not self._stopped.is_set():
            now = time.monotonic()
            if now >= due:
                self._Shoot(now)
                # A thread that was late does not catch up.
                due = max(due + 1 / FRAME_RATE, now)
            while self._outbox and self._outbox[0][0] <= now:
                self._SendToAll(heapq.heappop(self._outbox)[2], now)
            wake_at = min([due, *(entry[0] for entry in self._outbox[:1])])
            if select.select([self._socket], [], [], max(0.0, wake_at - now))[0]:
                self._Reply(*self._socket.recvfrom(2**16))

    def _Shoot(self, now: float) -> None:
        """Makes a frame and lays it in the outbox, if no fault keeps it from that."""
        if self.freeze is Freeze.SILENT:
            return
        if self.freeze is Freeze.NONE or not self._frame:
            self._number += 1
            with self._lock:
                self._frame = self._MakeFrame(now)
        frame = self._frame
        if self._random.random() < self.drop_share:
            return
        if self._random.random() < self.malformed_share:
            frame = self._Spoil(frame)
        send_at = now + self.delay + self.jitter * self._random.random()
        heapq.heappush(self._outbox, (send_at, self._number, frame))

    def _MakeFrame(self, now: float) -> bytes:
        bodies = []
        for name, pose in self._poses.items():
            tracked = name not in self._occluded
            row = pose if tracked else self._occluded[name]
            row = np.full_like(row, self.overwritten.get(name, row))
            mean_error = 0.0
            bodies.append(
                struct.pack("<i", self._ids_in_frames[name])
                + struct.pack("<7ffh", *row, mean_error, tracked)
            )
        empty = _section([])
        sections = [
            *[empty] * 2,  # Marker sets, unlabelled markers.
            _section(bodies),
            *[empty] * 5,  # Skeletons, assets, markers, force plates, devices.
        ]
        ns = int(now * _CLOCK_FREQUENCY)
        suffix = _SUFFIX.pack(
            *(0, 0),  # Timecode.
            self._number / FRAME_RATE,
            *(ns, ns, ns),  # Exposure, received, sent.
            *(0, 0),  # Precision time stamp: none.
            0,  # Neither recording nor edited.
            0,  # End of data.
        )
        prefix = struct.pack("<i", self._number)
        return _datagram(_Message.FRAME, prefix + b"".join(sections) + suffix)

    def _Spoil(self, datagram: bytes) -> bytes:
        """A malformed datagram in the place of a good one."""
        kind = self._random.integers(3)
        if kind == 0:  # Cut short.
            return datagram[: self._random.integers(1, len(datagram) - _SUFFIX.size)]
        if kind == 1:  # Noise.
            return datagram[:4] + self._random.bytes(len(datagram) - 4)
        # The last section, the devices, says that it is long.
        end = len(datagram) - _SUFFIX.size
        return datagram[: end - 8] + b"\xff" * 8 + datagram[end:]

    def _SendToAll(self, datagram: bytes, now: float) -> None:
        for client, heard in list(self._clients.items()):
            if now - heard > _CLIENT_TIMEOUT:
                del self._clients[client]
            else:
                self._socket.sendto(datagram, client)

    def _Reply(self, request: bytes, client: tuple[str, int]) -> None:
        kind = int.from_bytes(request[:2], "little")
        if kind == _Message.CONNECT or client in self._clients:
            self._clients[client] = time.monotonic()
        if kind == _Message.CONNECT:
            self._socket.sendto(_server_info(), client)
        elif kind == _Message.REQUEST_DEFINITIONS:
            with self._lock:
                ids = {name: self._ids[name] for name in self._poses}
            self._socket.sendto(_definitions(ids), client)


def _pose_row(X_OR: RigidTransform) -> np.ndarray:
    """Position and quaternion (x, y, z, w), shape (7,)."""
    w, *xyz = X_OR.rotation().ToQuaternion().wxyz()
    return np.array([*X_OR.translation(), *xyz, w])


def _datagram(message: _Message, payload: bytes) -> bytes:
    return struct.pack("<HH", message, len(payload)) + payload


def _section(items: list[bytes]) -> bytes:
    """A list in a frame: the number of items, the bytes that follow, the items."""
    content = b"".join(items)
    return struct.pack("<ii", len(items), len(content)) + content


def _server_info() -> bytes:
    connection = struct.pack("<QH?", _CLOCK_FREQUENCY, _DATA_PORT, False)
    return _datagram(
        _Message.SERVER_INFO,
        struct.pack("256s", _APPLICATION)
        + _APPLICATION_VERSION
        + _PROTOCOL_VERSION
        + connection
        + socket.inet_aton(_MULTICAST_ADDRESS),
    )


def _definitions(ids: dict[str, int]) -> bytes:
    """The definitions of rigid bodies, by name."""
    rigid_body = 1  # Kind of definition.
    payload = struct.pack("<i", len(ids))
    for name, number in ids.items():
        # No parent, no offset from it, no markers.
        content = (
            name.encode() + b"\0" + struct.pack("<ii3fi", number, -1, *[0.0] * 3, 0)
        )
        payload += struct.pack("<ii", rigid_body, len(content)) + content
    return _datagram(_Message.DEFINITIONS, payload)
