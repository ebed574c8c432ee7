"""Real-time scheduling for a driver's process, where the user may have it."""

import os
from pathlib import Path
from typing import Final

# Of 1 to 99; interrupts' threads have 50.
_PRIORITY: Final = 20


def ask_for_realtime() -> bool:
    """Has all threads of this process, and those that they start, scheduled first.

    On Linux that needs a limit `rtprio` of at least 20 for the user.  Without it the
    process runs like any other, and a busy computer may make it late.  A process that
    computes for long, or waits in a loop, must not have it: it keeps a core to itself.

    Returns:
        Whether it is granted.
    """
    return _schedule("SCHED_FIFO", _PRIORITY)


def leave_realtime() -> None:
    """Has all threads of this process scheduled like any other's."""
    _schedule("SCHED_OTHER", 0)


def _schedule(policy: str, priority: int) -> bool:
    try:
        for thread in Path("/proc/self/task").iterdir():
            os.sched_setscheduler(
                int(thread.name), getattr(os, policy), os.sched_param(priority)
            )
    except (OSError, AttributeError):  # No right to it, or no Linux.
        return False
    return True
