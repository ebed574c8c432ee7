"""Recordings of planar episodes: web pages that play in a browser, without a server."""

from typing import Final

import numpy as np
from pydrake.geometry import Box, Cylinder, Meshcat, Rgba, Shape
from pydrake.math import RigidTransform, RollPitchYaw

from rhp_drake.physics import CYLINDER, ObjectPhysics
from rhp_drake.safety import Fault
from rhp_drake.systems.meshcat_overlay import (
    HAND_COLOR,
    OBSTACLE_COLOR,
    PATH,
    TARGET_COLOR,
    MeshcatOverlay,
)
from rhp_drake.systems.receding_horizon_planner import NO_DECISION
from rhp_drake.task import BOX_SIDE, HAND_RECTANGLES, TABLE_LOWER, TABLE_UPPER
from rhp_drake.visualization import draw_bands

_EPISODE_PATH: Final = "/episode"
# The table and the fingers as in models/; the palm is no higher, to hide less.
_TABLE_COLOR: Final = (0.87, 0.80, 0.69)
_TABLE_THICKNESS: Final = 0.05  # m
_HAND_HEIGHT: Final = 0.05  # m
# The hand's path lies above the goal regions.
_BAND_WIDTH: Final = 0.008  # m
_BAND_HEIGHT: Final = 0.003  # m
# m in W.  Behind the robot, so that x points up and y to the left in the picture; high
# enough that no body hides the one behind it.
_CAMERA: Final = np.array([-0.18, 0.0, 1.18])
_CAMERA_TARGET: Final = np.array([0.49, 0.0, 0.0])


def record_episode(
    meshcat: Meshcat, states: np.ndarray, goals: np.ndarray, physics: ObjectPhysics
) -> str:
    """Makes a recording of an episode that was run in a planar world.

    An action takes one second.  The hand goes straight from pose to pose, as it did.
    What the boxes did during an action is not in the states: they move evenly from
    where they were before it to where they were after it, and so may seem to start
    before the hand touches them, or to overlap it.

    A goal region is stronger while its box is inside, see `MeshcatOverlay`; the hand's
    path appears action by action.  A box that fell hovers beside the table.

    Args:
        meshcat: Where to draw, from `visualization.MakeMeshcat`.  Its camera is moved
            and its recording overwritten.  What is drawn here is deleted again, so
            that one Meshcat serves any number of episodes.
        states: Before each action and after the last, shape (K, 3 + 3 m), K >= 1.
        goals: Shape (m, 2), m in W.
        physics: Of the m objects, which are drawn with its side lengths.

    Returns:
        The text of an HTML file, which plays when it is opened and loads nothing else.

    Raises:
        ValueError: If the shapes do not fit together, or if there is no state.
    """
    m = physics.num_objects
    if goals.shape != (m, 2) or states.shape != (len(states), 3 + 3 * m):
        raise ValueError(
            f"{m} objects need goals of shape ({m}, 2) and states of shape "
            f"(K, {3 + 3 * m}), not {goals.shape} and {states.shape}."
        )
    if len(states) == 0:
        raise ValueError("an episode has one state at least.")

    meshcat.SetCameraPose(_CAMERA, _CAMERA_TARGET)
    # Browsers interpolate between frames, so one frame a state is enough.
    meshcat.StartRecording(frames_per_second=1.0)
    try:
        _draw_bodies(meshcat, physics)
        _record_bodies(meshcat, states)
        _record_goals(meshcat, states, goals)
        _record_hand_path(meshcat, states[:, :2])
        meshcat.PublishRecording()
        return meshcat.StaticHtml()
    finally:
        meshcat.StopRecording()
        meshcat.Delete(_EPISODE_PATH)
        meshcat.Delete(PATH)  # The overlay's.
        meshcat.DeleteRecording()
        # Only publishing an empty recording makes Meshcat forget the one before.
        meshcat.PublishRecording()


def _draw_bodies(meshcat: Meshcat, physics: ObjectPhysics) -> None:
    """Draws the table where it stands; hand and objects still lack their poses."""
    center, size = (TABLE_LOWER + TABLE_UPPER) / 2, TABLE_UPPER - TABLE_LOWER
    _draw(
        meshcat,
        f"{_EPISODE_PATH}/table",
        Box(*size, _TABLE_THICKNESS),
        [*center, -_TABLE_THICKNESS / 2],
        _TABLE_COLOR,
    )
    for i, (x, y, half_x, half_y) in enumerate(HAND_RECTANGLES):
        _draw(
            meshcat,
            f"{_body_path(0)}/{i}",
            Box(2 * half_x, 2 * half_y, _HAND_HEIGHT),
            [x, y, _HAND_HEIGHT / 2],
            HAND_COLOR,
        )
    for i, (x, y) in enumerate(physics.side_lengths):
        is_round = physics.shapes[i] == CYLINDER
        _draw(
            meshcat,
            f"{_body_path(i + 1)}/0",
            Cylinder(x / 2, BOX_SIDE) if is_round else Box(x, y, BOX_SIDE),
            [0.0, 0.0, BOX_SIDE / 2],
            OBSTACLE_COLOR if i else TARGET_COLOR,
        )


def _draw(
    meshcat: Meshcat,
    path: str,
    shape: Shape,
    position: list[float],
    color: tuple[float, float, float],
) -> None:
    """Draws a shape with its centre at `position`, m in its parent's frame."""
    meshcat.SetObject(path, shape, Rgba(*color))
    meshcat.SetTransform(path, RigidTransform(position))


def _record_bodies(meshcat: Meshcat, states: np.ndarray) -> None:
    """Records the poses of hand and objects, which are the bodies 0 to m."""
    for k, state in enumerate(states):
        for i, (x, y, theta) in enumerate(state.reshape(-1, 3)):
            X_WBody = RigidTransform(RollPitchYaw(0.0, 0.0, theta), [x, y, 0.0])
            meshcat.SetTransform(_body_path(i), X_WBody, time_in_recording=k)


def _record_goals(meshcat: Meshcat, states: np.ndarray, goals: np.ndarray) -> None:
    """Draws the goal regions, and records whose box is inside."""
    overlay = MeshcatOverlay(meshcat, len(goals))
    context = overlay.CreateDefaultContext()
    overlay.GetInputPort("goals").FixValue(context, goals.ravel())
    overlay.GetInputPort("fault").FixValue(context, [float(Fault.NONE)])
    decision = overlay.GetInputPort("decision")
    no_decision = decision.Allocate()
    no_decision.set_value(NO_DECISION)
    decision.FixValue(context, no_decision)
    overlay.ExecuteInitializationEvents(context)
    for k, state in enumerate(states):
        context.SetTime(k)
        overlay.GetInputPort("state").FixValue(context, state)
        overlay.ForcedPublish(context)


def _record_hand_path(meshcat: Meshcat, positions: np.ndarray) -> None:
    """Draws the hand's way through `positions`, shape (K, 2), m in W.

    Recordings keep no new objects, so each action's part is there from the beginning,
    and only hidden until the action is over.
    """
    for k in range(len(positions) - 1):
        path = f"{_EPISODE_PATH}/hand_path/{k}"
        draw_bands(
            meshcat,
            path,
            positions[k : k + 1],
            positions[k + 1 : k + 2],
            np.array(HAND_COLOR),
            _BAND_WIDTH,
            _BAND_HEIGHT,
        )
        if meshcat.HasPath(path):  # Turns leave no trace.
            meshcat.SetProperty(path, "visible", False, time_in_recording=0)
            meshcat.SetProperty(path, "visible", True, time_in_recording=k + 1)


def _body_path(index: int) -> str:
    return f"{_EPISODE_PATH}/bodies/{index}"
