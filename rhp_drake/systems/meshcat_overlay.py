"""Draws the task, the planner's thoughts and faults in Meshcat."""

import math
import textwrap
from typing import TYPE_CHECKING, Final

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Cylinder, Meshcat, Rgba
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from rhp_drake import task
from rhp_drake.safety import Fault, describe
from rhp_drake.systems.receding_horizon_planner import NO_DECISION
from rhp_drake.visualization import FRAME_PERIOD, SKY, draw_bands, draw_text, set_sky

if TYPE_CHECKING:
    from rhp_drake.planning.policy import Decision

PATH: Final = "/overlay"
TARGET_COLOR: Final = (0.20, 0.66, 0.33)
OBSTACLE_COLOR: Final = (0.80, 0.16, 0.14)
HAND_COLOR: Final = (0.10, 0.32, 0.72)
_PALE: Final = 0.35  # How far towards white the roll-outs not chosen are drawn.
_OPACITY: Final = 0.3  # Of the goal regions.
# Heights above the table, m, far enough apart not to flicker.
_DISC_HEIGHT: Final = 0.002
_DISC_THICKNESS: Final = 0.0001
_PATH_HEIGHT: Final = 0.003
_BEST_HEIGHT: Final = 0.004
_PATH_WIDTH: Final = 0.004
_BEST_WIDTH: Final = 0.010
# After a fault: a frame around the workspace, and the sky.
FAULT_COLOR: Final = (0.85, 0.05, 0.05)
_FRAME_WIDTH: Final = 0.02
# Beside the base, where nothing hides it, and facing where the camera is at first.
_X_W_SIGN: Final = RigidTransform(
    RotationMatrix.MakeZRotation(math.radians(-23)), [-0.3, -0.5, 0.12]
)
_SIGN_WIDTH: Final = 24  # Letters of a line.
_SIGN_LINE: Final = 0.055  # m
_FAULT_SKY: Final = ([1.0, 0.80, 0.78], [0.85, 0.45, 0.42])


class MeshcatOverlay(LeafSystem):
    """Goal regions as discs, and the last decision's roll-outs as paths on the table.

    A disc is green for the target, red for an obstacle, and stronger while its object
    is inside.  Of each roll-out the hand's path is blue and the target's green; the
    roll-out with the highest return is drawn wide and dark.

    After a fault the workspace has a red frame and the background is red, and beside
    the robot stands why.  Only a forced publish draws that.

    Recordings keep properties but no new objects.  So each decision gets objects of
    its own, under a path with its number, and only their visibility changes in time.

    .. pydrake_system::

        name: MeshcatOverlay
        input_ports:
        - state
        - goals
        - decision
        - fault

    `state` has size 3 + 3 m and `goals` 2 m, see `rhp_drake.task`; `decision` is a
    DecisionRecord, see `RecedingHorizonPlanner`; `fault` has size 1, a `safety.Fault`.

    Args:
        meshcat: Where to draw.
        num_objects: m, the target included.
    """

    def __init__(self, meshcat: Meshcat, num_objects: int) -> None:
        super().__init__()
        self._meshcat = meshcat
        self._state = self.DeclareVectorInputPort("state", 3 + 3 * num_objects)
        self._goals = self.DeclareVectorInputPort("goals", 2 * num_objects)
        self._decision = self.DeclareAbstractInputPort(
            "decision", AbstractValue.Make(NO_DECISION)
        )
        self._fault = self.DeclareVectorInputPort("fault", 1)
        self.DeclareInitializationPublishEvent(self._PublishDiscs)
        self.DeclarePeriodicPublishEvent(FRAME_PERIOD, 0.0, self._PublishChanges)
        self.DeclareForcedPublishEvent(self._PublishAll)

    def _PublishDiscs(self, context: Context) -> EventStatus:
        """Draws the goal regions, and forgets the roll-outs of the run before."""
        self._meshcat.Delete(PATH)
        set_sky(self._meshcat, SKY, context.get_time())
        goals = self._goals.Eval(context).reshape(-1, 2)
        disc = Cylinder(task.GOAL_RADIUS, _DISC_THICKNESS)
        for i, goal in enumerate(goals):
            color = Rgba(*(OBSTACLE_COLOR if i else TARGET_COLOR), _OPACITY)
            # Discs may overlap, so each has its own height.
            height = _DISC_HEIGHT * (1 - i / len(goals))
            path = _disc_path(i)
            self._meshcat.SetObject(path, disc, color)
            self._meshcat.SetTransform(path, RigidTransform([*goal, height]))
            # A second disc on the first makes its color stronger.
            self._meshcat.SetObject(f"{path}/reached", disc, color)
            self._meshcat.SetTransform(
                f"{path}/reached", RigidTransform([0, 0, 2 * _DISC_THICKNESS])
            )
        return EventStatus.Succeeded()

    def _PublishChanges(self, context: Context) -> EventStatus:
        """Updates the discs' strength, and shows a decision that is new."""
        time = context.get_time()
        state = self._state.Eval(context)
        offsets = task.object_positions(state) - self._goals.Eval(context).reshape(
            -1, 2
        )
        for i, distance in enumerate(np.linalg.norm(offsets, axis=1)):
            reached = distance <= task.GOAL_RADIUS
            self._meshcat.SetProperty(
                f"{_disc_path(i)}/reached", "visible", bool(reached), time
            )
        record = self._decision.Eval(context)
        # Meshcat itself remembers what is drawn, so this system needs no state.
        if record.index >= 0 and not self._meshcat.HasPath(_path(record.index)):
            self._ShowRollOuts(record.index, record.decision, time)
        return EventStatus.Succeeded()

    def _PublishAll(self, context: Context) -> EventStatus:
        """Shows a fault, too.

        That takes a while, in which a real arm would go on: for when it was stopped.
        """
        self._PublishChanges(context)
        fault = Fault(int(self._fault.Eval(context)[0]))
        if fault != Fault.NONE and not self._meshcat.HasPath(_FAULT_PATH):
            self._ShowFault(fault, context.get_time())
        return EventStatus.Succeeded()

    def _ShowFault(self, fault: Fault, time: float) -> None:
        """Shows that the arm was stopped, and why."""
        (left, front), (right, back) = task.WORKSPACE_LOWER, task.WORKSPACE_UPPER
        corners = np.array([[left, front], [right, front], [right, back], [left, back]])
        draw_bands(
            self._meshcat,
            f"{_FAULT_PATH}/frame",
            corners,
            np.roll(corners, -1, axis=0),
            np.array(FAULT_COLOR),
            _FRAME_WIDTH,
            _BEST_HEIGHT,
        )
        lines = textwrap.wrap(f"Stopped: {describe(fault)}", _SIGN_WIDTH)
        draw_text(
            self._meshcat,
            f"{_FAULT_PATH}/sign",
            "\n".join(lines),
            _SIGN_LINE,
            np.array(FAULT_COLOR),
        )
        self._meshcat.SetTransform(f"{_FAULT_PATH}/sign", _X_W_SIGN)
        self._meshcat.SetProperty(_FAULT_PATH, "visible", False, 0.0)
        self._meshcat.SetProperty(_FAULT_PATH, "visible", True, time)
        set_sky(self._meshcat, _FAULT_SKY, time)

    def _ShowRollOuts(self, index: int, decision: "Decision", time: float) -> None:
        """Draws the roll-outs of decision number `index`, and hides those before."""
        path = _path(index)
        # A path without roll-outs still marks the decision as drawn.
        self._meshcat.SetTransform(path, RigidTransform())
        order = np.argsort(decision.returns, kind="stable")
        for rank, i in enumerate(order):
            best = rank == len(order) - 1
            self._DrawPath(
                f"{path}/{i}/hand",
                decision.roll_outs[i, :, :2],
                np.array(HAND_COLOR),
                best,
            )
            self._DrawPath(
                f"{path}/{i}/target",
                decision.roll_outs[i, :, 3:5],
                np.array(TARGET_COLOR),
                best,
            )
        # Before this time, a recording must not show it.
        self._meshcat.SetProperty(path, "visible", False, 0.0)
        self._meshcat.SetProperty(path, "visible", True, time)
        if self._meshcat.HasPath(_path(index - 1)):
            self._meshcat.SetProperty(_path(index - 1), "visible", False, time)

    def _DrawPath(
        self, path: str, points: np.ndarray, color: np.ndarray, best: bool
    ) -> None:
        """Draws a band on the table through `points`, shape (k, 2), m in W."""
        width = _BEST_WIDTH if best else _PATH_WIDTH
        height = _BEST_HEIGHT if best else _PATH_HEIGHT
        if not best:
            color = color + _PALE * (1 - color)
        draw_bands(self._meshcat, path, points[:-1], points[1:], color, width, height)


_FAULT_PATH: Final = f"{PATH}/fault"


def _disc_path(index: int) -> str:
    return f"{PATH}/goal/{index}"


def _path(index: int) -> str:
    return f"{PATH}/roll_outs/{index}"
