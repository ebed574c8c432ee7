"""A controller's RTDE interface and the port that takes its programs.

Tells and takes what ur_rtde needs, of protocol version 2.  A variable that `Controller`
does not simulate, a current for example or the tool's pose, is 0.
"""

import asyncio
import enum
import logging
import re
import struct
from typing import Final

import numpy as np

from rhp_drake.lab.controller import Controller
from rhp_drake.lab.rtde_packets import (
    INPUT_TYPES,
    OUTPUT_TYPES,
    PROTOCOL_VERSION,
    MalformedPackageError,
    PackageType,
    Recipe,
    Value,
    pack_package,
    read_package,
    split_names,
)
from rhp_drake.lab.tcp_server import TcpServer
from rhp_drake.station.ports import COMMAND_PERIOD

# Fixed, in the robot and in ur_rtde.
RTDE_PORT: Final = 30004
SCRIPT_PORT: Final = 30003
# Major, minor, bug fix, build: a CB3.
CONTROLLER_VERSION: Final = (3, 15, 8, 106339)

_MAX_RECIPES: Final = 255  # The id has one byte.
_HIGHEST_FREQUENCY: Final = 1 / COMMAND_PERIOD  # Hz
# Bytes that wait for a slow client before frames are left out.
_MAX_WAITING: Final = 1 << 16
# A program longer than this is none; ur_rtde's has about 40 kB.
_MAX_PROGRAM: Final = 1 << 20
# A program begins and ends at the margin; what is in it is indented.
_PROGRAM_BEGIN: Final = re.compile(rb"def\s")
_LOG: Final = logging.getLogger(__name__)


class Stream(enum.Enum):
    """What becomes of the frames that clients are sent."""

    LIVE = enum.auto()
    SILENT = enum.auto()  # None are sent.
    REPEATING = enum.auto()  # The last one is sent again and again.
    CORRUPT = enum.auto()  # Well-formed, but their values are random bytes.


class RtdeServer:
    """Serves RTDE and takes programs for a controller.

    Whoever calls the controller's `tick` calls `publish` after it.

    Attributes:
        stream: A fault of the stream.
        delay: By how much frames come late, s.
        jitter: Up to how much more each comes late, by chance, s.  Their order stays.

    Args:
        controller: Whose interface this is.
        host: Address to listen at, of loopback.
        random: What faults draw from, in the server's thread.

    Raises:
        InputError: If it cannot listen there.
    """

    def __init__(
        self, controller: Controller, host: str, random: np.random.Generator
    ) -> None:
        self.stream = Stream.LIVE
        self.delay = 0.0
        self.jitter = 0.0
        self._controller = controller
        self._clients: list[_Client] = []
        self._ticks = 0
        self._sent_at = 0.0
        self._random = random
        self._server = TcpServer(
            host, {RTDE_PORT: self._serve_rtde, SCRIPT_PORT: self._take_programs}
        )

    def publish(self) -> None:
        """Sends the controller's state to all clients that are due; never blocks."""
        self._server.call(self._publish, self._controller.outputs())

    def drop_connections(self) -> None:
        """Cuts all RTDE connections; clients may come again."""
        self._server.drop_connections(RTDE_PORT)

    def close(self) -> None:
        """Drops all clients and frees the ports.  May be called again."""
        self._server.close()

    # From here on all is done in the server's thread.

    def _publish(self, outputs: dict[str, Value]) -> None:
        self._ticks += 1
        for client in self._clients:
            client.update(outputs, self._ticks, self.stream, self._random)
        now = self._server.time()
        wanted = now + self.delay + self._random.uniform(0, self.jitter)
        # A frame never overtakes the one before.
        due = max(wanted, self._sent_at)
        frames = [(client, client.take_frame()) for client in self._clients]
        if due <= now:
            self._send(frames)
        else:
            self._sent_at = due + 1e-6
            self._server.call_at(due, self._send, frames)

    @staticmethod
    def _send(frames: "list[tuple[_Client, bytes]]") -> None:
        for client, frame in frames:
            client.send_frame(frame)

    async def _serve_rtde(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        client = _Client(writer)
        self._clients.append(client)
        try:
            while True:
                self._answer(client, *await read_package(reader))
                await writer.drain()
        finally:
            # Frames that are late find nobody.
            client.started = False
            self._clients.remove(client)

    def _answer(self, client: "_Client", package_type: int, payload: bytes) -> None:
        match package_type:
            case PackageType.PROTOCOL_VERSION:
                accepted = payload == struct.pack(">H", PROTOCOL_VERSION)
                client.reply(package_type, bytes([accepted]))
            case PackageType.CONTROLLER_VERSION:
                client.reply(package_type, struct.pack(">4I", *CONTROLLER_VERSION))
            case PackageType.SETUP_OUTPUTS:
                client.reply(package_type, client.set_outputs(payload).reply)
            case PackageType.SETUP_INPUTS:
                # An input belongs to one client as long as it is connected.
                others = [x.inputs for x in self._clients if x is not client]
                recipe = client.add_inputs(payload, frozenset().union(*others))
                client.reply(package_type, recipe.reply)
            case PackageType.START | PackageType.PAUSE:
                wanted = package_type == PackageType.START
                client.started = wanted and client.outputs is not None
                client.reply(package_type, bytes([client.started == wanted]))
            case PackageType.DATA:
                try:
                    self._controller.write_inputs(client.unpack(payload))
                except MalformedPackageError as error:
                    _LOG.debug("data left out: %s", error)
            case _:
                _LOG.debug("package of unknown type %d left out", package_type)

    async def _take_programs(
        self, reader: asyncio.StreamReader, _: asyncio.StreamWriter
    ) -> None:
        """A program is taken for the control script, whatever it says."""
        size: int | None = None  # Of the program that is being received.
        while line := await reader.readline():
            if size is None:
                if _PROGRAM_BEGIN.match(line):
                    size = 0
                elif line.strip():
                    _LOG.warning("left out, not a program: %r", line)
                continue
            size += len(line)
            if size > _MAX_PROGRAM:
                raise ValueError("a program without end")
            if line.rstrip() == b"end":
                size = None
                if not self._controller.start_program():
                    _LOG.warning("a program was refused: the robot is not ready")


class _Client:
    """One client of RTDE.

    Attributes:
        outputs: What it is sent; None until it says so.
        inputs: Names of the variables that it may write.
        started: Whether it wants frames.
    """

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self.outputs: Recipe | None = None
        self.inputs: frozenset[str] = frozenset()
        self.started = False
        self._writer = writer
        self._recipes: dict[int, Recipe] = {}
        self._every = 1  # Ticks from frame to frame.
        self._frame = b""
        self._due = False

    def set_outputs(self, payload: bytes) -> Recipe:
        """Makes it be sent what a setup package asks for, instead of what it was."""
        if len(payload) < struct.calcsize(">d"):
            raise MalformedPackageError("a setup of outputs without a frequency")
        (frequency,) = struct.unpack_from(">d", payload)
        recipe = Recipe(split_names(payload[8:]), OUTPUT_TYPES, 1)
        self.outputs = recipe if recipe.recipe_id else None
        if not 1 <= frequency <= _HIGHEST_FREQUENCY:
            frequency = _HIGHEST_FREQUENCY
        self._every = round(_HIGHEST_FREQUENCY / frequency)
        self._frame = b""
        return recipe

    def add_inputs(self, payload: bytes, in_use: frozenset[str]) -> Recipe:
        """Lets it write what a setup package asks for, if nobody else does."""
        if len(self._recipes) == _MAX_RECIPES:
            raise MalformedPackageError("more recipes than there are numbers for")
        names = split_names(payload)
        recipe = Recipe(names, INPUT_TYPES, len(self._recipes) + 1, in_use)
        if recipe.recipe_id:
            self._recipes[recipe.recipe_id] = recipe
            self.inputs |= set(names)
        return recipe

    def unpack(self, payload: bytes) -> dict[str, Value]:
        """The values of a data package, by name."""
        recipe = self._recipes.get(payload[0]) if payload else None
        if recipe is None:
            raise MalformedPackageError("data of an unknown recipe")
        return recipe.unpack(payload)

    def reply(self, package_type: int, payload: bytes) -> None:
        """Answers with a package of the type of the question."""
        self._writer.write(pack_package(package_type, payload))

    def update(
        self,
        outputs: dict[str, Value],
        ticks: int,
        stream: Stream,
        generator: np.random.Generator,
    ) -> None:
        """Makes the frame of a tick, or what a fault makes of it."""
        self._due = self.started and ticks % self._every == 0
        if not self._due or self.outputs is None:
            return
        if stream == Stream.SILENT:
            self._due = False
        elif stream != Stream.REPEATING or not self._frame:
            payload = self.outputs.pack(outputs)
            if stream == Stream.CORRUPT:
                payload = payload[:1] + generator.bytes(len(payload) - 1)
            self._frame = pack_package(PackageType.DATA, payload)

    def take_frame(self) -> bytes:
        """The frame to send, empty if none is due."""
        return self._frame if self._due else b""

    def send_frame(self, frame: bytes) -> None:
        """Sends it, unless the client left too many unread: a robot does the same."""
        waiting = self._writer.transport.get_write_buffer_size()
        if frame and self.started and waiting <= _MAX_WAITING:
            self._writer.write(frame)
