"""The process of the OptiTrack driver: what receives from Motive."""

from contextlib import redirect_stdout
import math
from multiprocessing.connection import Connection
import os
import sys
import time
from typing import Any, Final

import numpy as np

from rhp_drake.drivers.natnet_config import NatNetConfig, listed
from rhp_drake.drivers.pose_rows import NORM_TOLERANCE, POSE_SIZE
from rhp_drake.drivers.realtime import ask_for_realtime
from rhp_drake.drivers.shared_memory import SharedVector
from rhp_drake.errors import InputError, WorkError
from rhp_drake.workers import follow_parent

# How long the driver's `start` waits for the names of the rigid bodies.
START_TIME: Final = 5.0  # s
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


def receive(config: NatNetConfig, vector: SharedVector, answer: Connection) -> None:
    """What the driver's process does, until it is killed."""
    follow_parent()
    ask_for_realtime()
    _make_natnet_doubt_counts()
    # natnet prints a line for each odd datagram.
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        _Receiver(config, vector, answer).run()


class _Receiver:
    """The side of the driver that has the sockets.

    Args:
        config: Where and what.
        vector: Where to publish each body's X_OR, as a row, and after all rows the
            number of malformed datagrams; size m * POSE_SIZE + 1.
        answer: Where to send, once, whether the start went well: None or an error.
    """

    def __init__(
        self, config: NatNetConfig, vector: SharedVector, answer: Connection
    ) -> None:
        self._config = config
        self._vector = vector
        self._answer: Connection | None = answer
        self._rows = np.full((len(config.bodies), POSE_SIZE), np.nan)
        self._num_malformed = 0
        self._give_up_at = time.monotonic() + START_TIME
        self._row_of_id: dict[int, int] = {}
        self._last_number = -math.inf
        # What natnet has received and nobody has looked at.
        self._frames: list[Any] = []
        self._definitions: list[Any] = []

    def run(self) -> None:
        """Connects, again and again."""
        from natnet import NatNetClient

        config = self._config
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
            self._GiveUp(f"from {config.local_address}: {problem}")

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
            except Exception as error:
                # Of many kinds, by what is malformed; the next update goes on after it.
                self._num_malformed += 1
                if self._num_malformed == 1:
                    text = f"rhp: a datagram of Motive's is dropped: {error}."
                    print(text, file=sys.stderr, flush=True)
                emptied_next = emptied
                self._Publish()
            while self._definitions:
                self._TakeDefinitions(self._definitions.pop(0))
            while self._frames:
                if self._TakeFrame(self._frames.pop(0), received=emptied):
                    heard = now
                    self._Publish()
            emptied = emptied_next
            self._GiveUp("it sends frames, but no names that can be read")
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
                f"Motive has no rigid body {listed(missing)}; it has "
                f"{listed(list(ids)) or 'none'}."
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
        for body in frame.rigid_bodies:
            row = self._row_of_id.get(body.id_num)
            x, y, z, w = body.rot
            pose = [*body.pos, w, x, y, z]
            if (
                row is not None
                and body.tracking_valid
                and np.isfinite(pose).all()
                and abs(np.linalg.norm(body.rot) - 1) <= NORM_TOLERANCE
            ):
                self._rows[row] = [*pose, received]
        return True

    def _Publish(self) -> None:
        self._vector.write(np.append(self._rows, self._num_malformed))

    def _GiveUp(self, problem: str) -> None:
        """Says what is wrong, if the start has taken too long."""
        if time.monotonic() > self._give_up_at:
            where = f"{self._config.server_address}:{self._config.command_port}"
            self._Answer(WorkError(f"no NatNet server at {where}, {problem}."))

    def _Answer(self, error: Exception | None) -> None:
        """Says how the start went, unless that has been said; the parent ends it."""
        if self._answer is not None:
            self._answer.send(error)
            self._answer.close()
            self._answer = None
