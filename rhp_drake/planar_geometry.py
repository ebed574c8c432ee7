"""Oriented rectangles in the plane."""

import numpy as np


def rectangles_overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether rectangles overlap, by the separating-axis theorem.

    Args:
        a: Shape (..., 5): centre x, y, angle (rad), half lengths along the own axes.
        b: Likewise; shapes are broadcast.

    Returns:
        Booleans of the broadcast shape (...).
    """
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    ca, sa = np.cos(a[..., 2]), np.sin(a[..., 2])
    cb, sb = np.cos(b[..., 2]), np.sin(b[..., 2])
    # |cosine| and |sine| of the relative angle project one's half lengths on the
    # other's axes.
    c, s = np.abs(ca * cb + sa * sb), np.abs(sa * cb - ca * sb)
    ax, ay, bx, by = a[..., 3], a[..., 4], b[..., 3], b[..., 4]
    return (
        (np.abs(ca * dx + sa * dy) < ax + bx * c + by * s)
        & (np.abs(ca * dy - sa * dx) < ay + bx * s + by * c)
        & (np.abs(cb * dx + sb * dy) < bx + ax * c + ay * s)
        & (np.abs(cb * dy - sb * dx) < by + ax * s + ay * c)
    )
