"""Serves TCP clients in a thread, so that whoever has the arm never waits for them."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
import ipaddress
import logging
from threading import Thread
from typing import Any, Final, TypeAlias

from rhp_drake.errors import InputError

# What is done for one client; it ends when the client goes or has to go.
Session: TypeAlias = Callable[
    [asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]
]

_LOG: Final = logging.getLogger(__name__)
# What a client may make go wrong in its own session: it goes away, or sends nonsense.
_CLIENT_ERRORS: Final = (OSError, EOFError, ValueError)


class TcpServer:
    """Listens at some ports of a host, until closed.

    Clients that send nonsense or vanish end their own session, and nothing else.

    Args:
        host: Its address, of loopback (127.x.y.z).
        sessions: What to do for a client, by port.

    Raises:
        InputError: If the address is not of loopback, or a port is taken.
    """

    def __init__(self, host: str, sessions: Mapping[int, Session]) -> None:
        if not _is_loopback(host):
            raise InputError(f"{host}: a virtual lab listens at 127.x.y.z only.")
        self._servers: list[asyncio.Server] = []
        self._writers: dict[asyncio.StreamWriter, int] = {}
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._run(self._listen(host, sessions))
        except OSError as error:
            self.close()
            raise InputError(f"{host}: cannot listen: {error.strerror}.") from None

    def call(self, function: Callable[..., object], *arguments: object) -> None:
        """Has a function called in the server's thread, soon; from any thread."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, *arguments)

    def time(self) -> float:
        """The clock of `call_at`, s."""
        return self._loop.time()

    def call_at(
        self, time: float, function: Callable[..., object], *arguments: object
    ) -> None:
        """Has a function called at a time; from the server's thread only."""
        self._loop.call_at(time, function, *arguments)

    def drop_connections(self, port: int) -> None:
        """Cuts the connections of all clients of a port; from any thread."""
        self.call(self._drop, port)

    def close(self) -> None:
        """Drops all clients and frees the ports.  May be called again."""
        if self._loop.is_closed():
            return
        self._run(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _listen(self, host: str, sessions: Mapping[int, Session]) -> None:
        for port, session in sessions.items():
            serve = self._serving(session, port)
            self._servers.append(await asyncio.start_server(serve, host, port))

    def _serving(self, session: Session, port: int) -> Session:
        async def serve(
            reader: asyncio.StreamReader, writer: asyncio.StreamWriter
        ) -> None:
            self._writers[writer] = port
            try:
                await session(reader, writer)
            except _CLIENT_ERRORS as error:
                _LOG.debug("port %d: a client is gone: %s", port, error)
            except asyncio.CancelledError:
                # Only `close` cancels, and needs no answer.
                pass
            except Exception:
                _LOG.exception("port %d: a client's session failed", port)
            finally:
                del self._writers[writer]
                writer.close()

        return serve

    def _drop(self, port: int) -> None:
        for writer, its_port in self._writers.items():
            if its_port == port:
                writer.transport.abort()

    async def _end(self) -> None:
        for server in self._servers:
            server.close()
        for writer in self._writers:
            writer.transport.abort()
        # Sessions that wait for a client now end; what else they wait for is cut short.
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
