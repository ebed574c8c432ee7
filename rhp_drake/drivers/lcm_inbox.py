"""Messages that come over LCM: which count, and how old they are."""

from collections.abc import Callable
import math
import struct
import sys
import time
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pydrake.lcm import DrakeLcmInterface

# How much slower a sender's clock may be than ours: two quartz clocks differ by less.
_DRIFT: Final = 2e-4


def utime() -> int:
    """Now, for what is sent: microseconds of a clock that never goes back."""
    return int(time.monotonic() * 1e6)


class SenderClock:
    """Tells when something happened on another computer, by its own stamps.

    Nobody sets the two clocks alike.  Of all that has come, the message that came
    soonest after its stamp tells how far apart they are.  An age by it lacks that one
    message's time on the way, and no more: what is late looks late.
    """

    def __init__(self) -> None:
        self._newest: int | None = None
        self._offset = math.inf
        self._heard = -math.inf

    def receive(self, utime: int, now: float) -> bool:
        """Notes a message, and says whether it is newer than all before.

        Args:
            utime: When it was sent, microseconds of the sender's clock.
            now: s of time.monotonic.
        """
        if self._newest is not None and utime <= self._newest:
            return False
        # The clocks may drift apart, but not by as much as what is late.
        drift = _DRIFT * (now - self._heard) if self._newest is not None else 0.0
        self._offset = min(now - utime * 1e-6, self._offset + drift)
        self._newest, self._heard = utime, now
        return True

    def to_ours(self, utime: int) -> float:
        """A time of the sender's clock as s of time.monotonic."""
        return utime * 1e-6 + self._offset


class Inbox:
    """Receives one kind of message on one channel.

    What is malformed is dropped, and the first time said why; what is no newer than
    something before, repeated or overtaken, is dropped, too.

    Args:
        lcm: Calls, in `HandleSubscriptions`.
        channel: Its name.
        message_type: A class that lcm-gen made, with a `utime`.
        take: Called with each message that is left.
        check: Raises a ValueError if a message makes no sense; all do by default.
    """

    def __init__(
        self,
        lcm: "DrakeLcmInterface",
        channel: str,
        message_type: Any,
        take: Callable[[Any], None],
        check: Callable[[Any], None] = lambda message: None,
    ) -> None:
        self.clock = SenderClock()
        self._channel = channel
        self._message_type = message_type
        self._check = check
        self._take = take
        self._complained = False
        lcm.Subscribe(channel, self._Receive)

    def _Receive(self, data: bytes) -> None:
        now = time.monotonic()
        try:
            message = self._message_type.decode(data)
            self._check(message)
        except (ValueError, struct.error) as error:
            if not self._complained:
                self._complained = True
                text = f"rhp: a message on {self._channel} is dropped: {error}."
                print(text, file=sys.stderr, flush=True)
            return
        if self.clock.receive(message.utime, now):
            self._take(message)
