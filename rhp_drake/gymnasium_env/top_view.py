"""A picture of a state from above."""

from typing import Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
import numpy as np

from rhp_drake.physics import ObjectPhysics
from rhp_drake.systems.meshcat_overlay import (
    HAND_COLOR,
    OBSTACLE_COLOR,
    TARGET_COLOR,
)
from rhp_drake.task import (
    GOAL_RADIUS,
    HAND_RECTANGLES,
    TABLE_LOWER,
    TABLE_UPPER,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    state_rectangles,
)

_SIZE: Final = 480  # Pixels.
_DPI: Final = 96
_MARGIN: Final = 0.02  # m around the table.
_TABLE_COLOR: Final = "#ece7df"
_EDGE_COLOR: Final = "#b9b0a2"
_CORNERS: Final = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])


def draw_top_view(
    state: np.ndarray, goals: np.ndarray, physics: ObjectPhysics
) -> np.ndarray:
    """Hand, boxes and their goal regions on the table, in Meshcat's colours.

    x points up and y to the left, as somebody behind the robot sees them; a dashed line
    is where the hand may go.

    Args:
        state: Shape (3 + 3 m,).
        goals: Shape (m, 2).
        physics: Of the m boxes.

    Returns:
        Bytes of shape (480, 480, 3).
    """
    figure = Figure(figsize=(_SIZE / _DPI, _SIZE / _DPI), dpi=_DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    # Drawn in (-y, x).
    axes.set_xlim(-TABLE_UPPER[1] - _MARGIN, -TABLE_LOWER[1] + _MARGIN)
    axes.set_ylim(TABLE_LOWER[0] - _MARGIN, TABLE_UPPER[0] + _MARGIN)
    axes.set_axis_off()
    for lower, upper, look in (
        (TABLE_LOWER, TABLE_UPPER, {"facecolor": _TABLE_COLOR}),
        (WORKSPACE_LOWER, WORKSPACE_UPPER, {"fill": False, "linestyle": "--"}),
    ):
        width, depth = upper[1] - lower[1], upper[0] - lower[0]
        corner = (-upper[1], lower[0])
        axes.add_patch(Rectangle(corner, width, depth, edgecolor=_EDGE_COLOR, **look))

    colors = [TARGET_COLOR] + [OBSTACLE_COLOR] * (len(goals) - 1)
    for (x, y), color in zip(goals, colors, strict=True):
        disc = Circle((-y, x), GOAL_RADIUS, facecolor=color, alpha=0.25)
        axes.add_patch(disc)
    rectangles = state_rectangles(state)
    num_hand = len(HAND_RECTANGLES)
    rectangles[num_hand:, 3:] = physics.side_lengths / 2
    for (x, y, angle, *half), color in zip(
        rectangles, [HAND_COLOR] * num_hand + colors, strict=True
    ):
        c, s = np.cos(angle), np.sin(angle)
        corners = [x, y] + _CORNERS * half @ np.array([[c, s], [-s, c]])
        drawn = np.column_stack([-corners[:, 1], corners[:, 0]])
        axes.add_patch(Polygon(drawn, facecolor=color, edgecolor="white"))
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
