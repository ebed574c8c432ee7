"""Draws the tree of a search on the table, in Meshcat, while it grows."""

import time
from typing import TYPE_CHECKING, Final

import numpy as np

from rhp_drake.systems.meshcat_overlay import (
    HAND_COLOR,
    OBSTACLE_COLOR,
    PATH,
    TARGET_COLOR,
)
from rhp_drake.task import object_positions
from rhp_drake.visualization import draw_bands

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

    from rhp_drake.planning.search import Growth

_PERIOD: Final = 0.1  # s on the wall between two drawings.
_WIDTH: Final = 0.004  # m
# m above the table: over the overlay's discs, under its paths.
_HAND_HEIGHT: Final = 0.0024
_OBSTACLE_HEIGHT: Final = 0.0026
_TARGET_HEIGHT: Final = 0.0028
# Paler than the plan, which the overlay draws over them.
_HAND_COLOR: Final = 0.5 + 0.5 * np.array(HAND_COLOR)
_TARGET_COLOR: Final = 0.2 + 0.8 * np.array(TARGET_COLOR)
_OBSTACLE_COLOR: Final = 0.2 + 0.8 * np.array(OBSTACLE_COLOR)


class TreeDrawing:
    """The present tree of the present search; that with a plan stays beside the next.

    An edge shows how the hand (blue), the target (green) and the obstacles (red) move.
    Recordings keep properties but no new objects, so that each search has a path of
    its own, and only its visibility changes in time.

    Args:
        meshcat: Where to draw, beside the `MeshcatOverlay`.
    """

    def __init__(self, meshcat: "Meshcat") -> None:
        self._meshcat = meshcat
        self._num_searches = 0
        self._num_trees = 0
        self._num_drawings = 0
        self._drawn_at = 0.0
        # Where each new edge begins and ends, each of shape (k, 1 + m, 2).
        self._begins: list[np.ndarray] = []
        self._ends: list[np.ndarray] = []

    def begin_search(self) -> None:
        """Expects the growth of another search."""
        self._num_searches += 1
        self._num_trees = 0

    def add(self, growth: "Growth") -> None:
        """Takes note of new edges, and now and then draws them."""
        if growth.num_trees != self._num_trees and growth.plan_length is None:
            self._meshcat.Delete(self._path())
            self._num_trees = growth.num_trees
            self._begins.clear()
            self._ends.clear()
        ends = _positions(growth.children)
        self._begins.append(np.broadcast_to(_positions(growth.source), ends.shape))
        self._ends.append(ends)
        if time.perf_counter() - self._drawn_at > _PERIOD:
            self.draw()

    def draw(self) -> None:
        """Draws the edges that are not drawn yet."""
        self._drawn_at = time.perf_counter()
        if not self._begins:
            return
        begins, ends = np.concatenate(self._begins), np.concatenate(self._ends)
        self._begins.clear()
        self._ends.clear()
        self._num_drawings += 1
        path = f"{self._path()}/{self._num_drawings}"
        for name, bodies, color, height in (
            ("hand", slice(0, 1), _HAND_COLOR, _HAND_HEIGHT),
            ("target", slice(1, 2), _TARGET_COLOR, _TARGET_HEIGHT),
            ("obstacles", slice(2, None), _OBSTACLE_COLOR, _OBSTACLE_HEIGHT),
        ):
            draw_bands(
                self._meshcat,
                f"{path}/{name}",
                begins[:, bodies].reshape(-1, 2),
                ends[:, bodies].reshape(-1, 2),
                color,
                _WIDTH,
                height,
            )

    def show_from(self, time: float) -> None:
        """Lets recordings show the tree of this search from a simulated time (s) on."""
        path = self._path()
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
        if self._num_searches > 1:
            before = self._path(self._num_searches - 1)
            self._meshcat.SetProperty(before, "visible", False, time)

    def _path(self, search: int | None = None) -> str:
        return f"{PATH}/tree/{search or self._num_searches}"


def _positions(states: np.ndarray) -> np.ndarray:
    """Where the hand and the objects are, shape (..., 1 + m, 2), m in W."""
    return np.concatenate([states[..., None, :2], object_positions(states)], axis=-2)
