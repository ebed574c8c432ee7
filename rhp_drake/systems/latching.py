"""Where a command begins: at the joints' measured positions."""

import numpy as np
from pydrake.systems.framework import Context, InputPort


def latch_position(measured_port: InputPort, context: Context) -> np.ndarray:
    """The measured joint positions, shape (6,), rad, to hold from now on.

    Raises:
        RuntimeError: If they are not finite: an arm must not start from nowhere.
    """
    measured = measured_port.Eval(context)
    if not np.isfinite(measured).all():
        raise RuntimeError(
            f"The measured joint positions {measured} are not finite: there is no "
            "position to hold."
        )
    return measured
