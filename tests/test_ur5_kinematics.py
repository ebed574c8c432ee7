import itertools
import math

import numpy as np
from pydrake.multibody.parsing import (
    LoadModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
import pytest

from rhp_drake import task
from rhp_drake.errors import InputError
from rhp_drake.resources import make_package_map, models_path
from rhp_drake.station.ports import JOINT_NAMES
from rhp_drake.station.ur5_kinematics import (
    PUSHING_HEIGHT,
    forward_kinematics,
    hand_pose,
    inverse_kinematics,
)


def make_plant() -> MultibodyPlant:
    plant = MultibodyPlant(time_step=0.0)
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    directives = LoadModelDirectives(str(models_path() / "station.dmd.yaml"))
    ProcessModelDirectives(directives, parser)
    plant.Finalize()
    return plant


def workspace_poses(num_positions: int, num_headings: int) -> list[tuple]:
    lower, upper = task.WORKSPACE_LOWER, task.WORKSPACE_UPPER
    return list(
        itertools.product(
            np.linspace(lower[0], upper[0], num_positions),
            np.linspace(lower[1], upper[1], num_positions),
            np.linspace(-task.MAX_HEADING, task.MAX_HEADING, num_headings),
        )
    )


def test_forward_kinematics_is_that_of_the_urdf():
    plant = make_plant()
    context = plant.CreateDefaultContext()
    hand = plant.GetFrameByName("hand")
    generator = np.random.default_rng(0)
    for q in generator.uniform(-2 * np.pi, 2 * np.pi, size=(50, 6)):
        plant.SetPositions(context, q)
        expected = hand.CalcPoseInWorld(context).GetAsMatrix4()
        np.testing.assert_allclose(forward_kinematics(q), expected, atol=1e-9)


def test_urdf_has_the_published_limits():
    plant = make_plant()
    arm = plant.GetModelInstanceByName("ur5")
    effort = [
        plant.GetJointActuatorByName(name, arm).effort_limit() for name in JOINT_NAMES
    ]
    assert effort == [150, 150, 150, 28, 28, 28]
    turns = plant.GetPositionUpperLimits() / math.pi
    np.testing.assert_allclose(turns, [2, 2, 1, 2, 2, 2])
    np.testing.assert_allclose(plant.GetVelocityUpperLimits(), np.pi)


def test_round_trip_within_the_limits_over_the_whole_workspace():
    plant = make_plant()
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    for height in (PUSHING_HEIGHT, 0.15):
        for pose in workspace_poses(num_positions=9, num_headings=7):
            q = inverse_kinematics(pose, height)
            assert (q >= lower).all()
            assert (q <= upper).all()
            np.testing.assert_allclose(hand_pose(q), pose, atol=1e-9)
            X_WH = forward_kinematics(q)
            np.testing.assert_allclose(X_WH[2], [0, 0, 1, height], atol=1e-9)


def test_neighbouring_poses_have_neighbouring_joint_positions():
    # Nowhere does a millimetre take any joint further than 1.5 degrees.
    for pose in workspace_poses(num_positions=13, num_headings=2):
        q = inverse_kinematics(pose)
        for step in ([1e-3, 0, 0], [0, 1e-3, 0]):
            inward = np.where(np.array(pose) > [0.5, 0, 0], -1, 1)
            neighbour = inverse_kinematics(pose + inward * step)
            assert np.abs(neighbour - q).max() < math.radians(1.5)


def test_hand_pose_of_a_tool_off_vertical_is_near_its_joints_turn():
    q = inverse_kinematics([0.5, 0.1, 5.0])
    pose = hand_pose(q + 0.01)
    np.testing.assert_allclose(pose, [0.5, 0.1, 5.0], atol=0.03)


@pytest.mark.parametrize(
    ("pose", "height", "message"),
    [
        ((0.95, 0.0, 0.0), PUSHING_HEIGHT, "reach"),
        ((0.5, 0.0, 0.0), 1.0, "reach"),
        ((0.05, 0.0, 0.0), PUSHING_HEIGHT, "too near"),
        ((0.5, 0.0, 7.0), PUSHING_HEIGHT, "wrist 3"),
        ((math.nan, 0.0, 0.0), PUSHING_HEIGHT, "too near"),
        ((0.5, 0.0, math.nan), PUSHING_HEIGHT, "wrist 3"),
    ],
)
def test_out_of_reach(pose, height, message):
    with pytest.raises(InputError, match=message):
        inverse_kinematics(pose, height)
