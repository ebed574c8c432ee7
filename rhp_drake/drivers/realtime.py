"""Real-time scheduling for a driver's process, where the user may have it."""

import os
from typing import Final

# Of 1 to 99; interrupts' threads have 50.
_PRIORITY: Final = 20


def ask_for_realtime() -> bool:
    """Has this process, and threads that it starts from now on, scheduled first.

    On Linux that needs a limit `rtprio` of at least 20 for the user.  Without it the
    process runs like any other, and a busy computer may make it late.

    Returns:
        Whether it is granted.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        return False
    return True
