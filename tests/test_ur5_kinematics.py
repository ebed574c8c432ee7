"""Kinematics of the UR5, nominal and as factory calibrations have it."""

import itertools
import math

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
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
from rhp_drake.station import ur5_kinematics
from rhp_drake.station.ports import JOINT_NAMES
from rhp_drake.station.ur5_kinematics import (
    DH_PARAMETERS,
    HAND_TURN,
    PUSHING_HEIGHT,
    TOOL_LENGTH,
    DhDeltas,
    Ur5Kinematics,
    forward_kinematics,
    hand_pose,
    inverse_kinematics,
)

# A real UR5's calibration, as UR's ROS driver prints it, the nominal figures added:
# issue 457 of UniversalRobots/Universal_Robots_ROS_Driver.
UR5_THETA = [
    -9.62699668632896e-06,
    -1.43707039992005,
    2.02543119975016,
    -0.588254688694989,
    4.13647390228702e-05,
    8.1737464953645e-06,
]
UR5_A = [
    0.000279332356195598,
    -0.0566854832098269,
    -0.32646702272051,
    1.49388687216263e-05,
    2.23692592990586e-07,
    0.0,
]
UR5_D = [
    0.0888794492754001,
    574.241384579456,
    -507.363402098168,
    -66.7676839353205,
    0.0949734691141216,
    0.0825625014554953,
]
UR5_ALPHA = [
    1.57033858830411,
    -0.000733893428160216,
    0.00325607356326439,
    1.57040005185553,
    -1.57101000328584,
    0.0,
]


def draw_deltas(seed: int) -> DhDeltas:
    """As large as what machining leaves."""
    generator = np.random.default_rng(seed)
    return DhDeltas(*generator.normal(scale=1e-3, size=(4, 6)).tolist())


REAL = DhDeltas(
    UR5_THETA,
    *np.subtract([UR5_A, UR5_D, UR5_ALPHA], DH_PARAMETERS.T).tolist(),
)
DELTAS = {
    "real": REAL,
    "compensating": DhDeltas(
        delta_d=[0.0, 0.3, -0.25, -0.05, 0.0, 0.0], delta_alpha=[1e-3] * 6
    ),
    "whole_turn": DhDeltas(delta_theta=[1e-3, 0.0, math.tau, 0.0, 0.0, 0.0]),
    "drawn_1": draw_deltas(1),
    "drawn_2": draw_deltas(2),
}


def dh_product(deltas: DhDeltas, q: np.ndarray) -> np.ndarray:
    """X_WH by Drake's transforms, a joint's parameter at a time."""
    turn = RotationMatrix.MakeZRotation
    X = RigidTransform(turn(math.pi), [0, 0, 0])
    for i, (a, d, alpha) in enumerate(DH_PARAMETERS):
        X = (
            X
            @ RigidTransform(turn(q[i] + deltas.delta_theta[i]), [0, 0, 0])
            @ RigidTransform([0, 0, d + deltas.delta_d[i]])
            @ RigidTransform([a + deltas.delta_a[i], 0, 0])
            @ RigidTransform(
                RotationMatrix.MakeXRotation(alpha + deltas.delta_alpha[i]), [0, 0, 0]
            )
        )
    down = RotationMatrix.MakeXRotation(math.pi)
    R_TH = turn(-math.pi / 2 - HAND_TURN) @ down
    return (X @ RigidTransform(R_TH, [0, 0, TOOL_LENGTH])).GetAsMatrix4()


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


def test_nominal_figures_change_no_bit():
    # As files have them: numbers that are given, and are zero.
    given = Ur5Kinematics(DhDeltas(*[[0, 0.0, -0.0, 0, 0, 0]] * 4))
    cosines, sines = (0, 1, 1, 0, 0, 1), (1, 0, 0, 1, -1, 0)
    for pose in workspace_poses(num_positions=5, num_headings=3):
        q = ur5_kinematics._closed_form(pose, PUSHING_HEIGHT)
        np.testing.assert_array_equal(inverse_kinematics(pose), q)
        np.testing.assert_array_equal(given.inverse_kinematics(pose), q)
        X = np.diag([-1.0, -1.0, 1.0, 1.0])
        for angle, (a, d, _), ca, sa in zip(
            q, DH_PARAMETERS, cosines, sines, strict=True
        ):
            c, s = math.cos(angle), math.sin(angle)
            X = X @ [
                [c, -s * ca, s * sa, a * c],
                [s, c * ca, -c * sa, a * s],
                [0, sa, ca, d],
                [0, 0, 0, 1],
            ]
        expected = X @ ur5_kinematics._X_TH
        np.testing.assert_array_equal(forward_kinematics(q), expected)
        np.testing.assert_array_equal(given.forward_kinematics(q), expected)


@pytest.mark.parametrize("name", DELTAS)
def test_forward_kinematics_of_a_particular_arm(name):
    arm = Ur5Kinematics(DELTAS[name])
    generator = np.random.default_rng(0)
    for q in generator.uniform(-2 * np.pi, 2 * np.pi, size=(50, 6)):
        expected = dh_product(DELTAS[name], q)
        np.testing.assert_allclose(arm.forward_kinematics(q), expected, atol=1e-9)


@pytest.mark.parametrize("name", DELTAS)
def test_round_trip_of_a_particular_arm(name):
    arm = Ur5Kinematics(DELTAS[name])
    for height in (PUSHING_HEIGHT, 0.15):
        for pose in workspace_poses(num_positions=7, num_headings=5):
            q = arm.inverse_kinematics(pose, height)
            np.testing.assert_allclose(arm.hand_pose(q), pose, atol=1e-9)
            X_WH = dh_product(DELTAS[name], q)
            np.testing.assert_allclose(X_WH[2], [0, 0, 1, height], atol=1e-9)
            np.testing.assert_allclose(X_WH[:2, 3], pose[:2], atol=1e-9)
            # The same branch.
            turned = np.abs(q - inverse_kinematics(pose, height)).max()
            assert 0 < turned < 0.1


def test_a_factory_calibration_moves_the_hand_by_millimetres():
    # Its links seem to be half a kilometre long.
    arm = Ur5Kinematics(REAL)
    misses = []
    for pose in workspace_poses(num_positions=5, num_headings=3):
        X_WH = arm.forward_kinematics(inverse_kinematics(pose))
        misses.append(np.linalg.norm(X_WH[:3, 3] - [*pose[:2], PUSHING_HEIGHT]))
    assert 0.001 < max(misses) < 0.005


@pytest.mark.parametrize(
    ("deltas", "message"),
    [
        (DhDeltas(delta_theta=[0.0] * 5), "delta_theta is .* six finite numbers"),
        (DhDeltas(delta_a=[0.0] * 5 + [math.nan]), "delta_a is .* six finite"),
        (DhDeltas(delta_d=[math.inf] + [0.0] * 5), "delta_d is .* six finite"),
        (DhDeltas(delta_alpha=[]), "delta_alpha is .* six finite numbers"),
        # One of the large ones forgotten.
        (DhDeltas(delta_d=[0.0, 0.3, -0.25, 0.0, 0.0, 0.0]), "move the hand by more"),
        (DhDeltas(delta_theta=[0.0] * 5 + [math.pi]), "turn the hand by more"),
        (DhDeltas(delta_d=[0.0, 0.0, 0.0, 0.028, 0.0, 0.0]), "cannot reach its work"),
    ],
)
def test_impossible_figures(deltas, message):
    with pytest.raises(InputError, match=message):
        Ur5Kinematics(deltas)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ((0.9045, 0.0, 0.0), "reach"),
        ((0.05, 0.0, 0.0), "too near"),
        ((0.5, 0.0, 7.0), "wrist 3"),
        ((math.nan, 0.0, 0.0), "too near"),
    ],
)
def test_out_of_a_particular_arms_reach(pose, message):
    # A forearm that is 2 cm short.
    arm = Ur5Kinematics(DhDeltas(delta_a=[0.0, 0.0, 0.02, 0.0, 0.0, 0.0]))
    with pytest.raises(InputError, match=message):
        arm.inverse_kinematics(pose)
