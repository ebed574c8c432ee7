"""Where a driver is reached over LCM, and what it calls the objects."""

from dataclasses import dataclass, field
import ipaddress
import re
from typing import Final

from rhp_drake.errors import InputError

COMMAND_CHANNEL: Final = "UR_COMMAND"
STATUS_CHANNEL: Final = "UR_STATUS"
POSES_CHANNEL: Final = "OBJECT_POSES"

_URL: Final = re.compile(r"udpm://([0-9.]+):([0-9]{1,5})(?:\?ttl=([0-9]{1,3}))?")


@dataclass
class LcmConfig:
    """Where a driver is reached over LCM, and what it calls the objects.

    Attributes:
        url: LCM's own: a multicast group, a port, and how far it goes.  `ttl=0`, also
            LCM's default, stays on this computer; `ttl=1` reaches all that are in its
            network, and whoever is there can command the arm.
        objects: Their names in the driver's messages, in the task's order.
    """

    # LCM's default group and port.
    url: str = "udpm://239.255.76.67:7667?ttl=0"
    objects: list[str] = field(default_factory=list)

    def validate(self) -> None:
        """Raises an InputError if the URL is none, or an object is named twice."""
        parts = _URL.fullmatch(self.url)
        try:
            good = (
                parts is not None
                and ipaddress.IPv4Address(parts[1]).is_multicast
                and 0 < int(parts[2]) < 2**16
                and int(parts[3] or 0) < 2**8
            )
        except ipaddress.AddressValueError:
            good = False
        # Drake itself would say it on the console, and go on without LCM.
        if not good:
            raise InputError(
                f"lcm.url is {self.url!r}; it must be such as {LcmConfig.url!r}."
            )
        if len(set(self.objects)) < len(self.objects):
            raise InputError(
                f"lcm.objects must name different objects, not {self.objects}."
            )
