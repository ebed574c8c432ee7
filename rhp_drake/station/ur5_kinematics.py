"""Closed-form kinematics of the UR5 with the hand held upright.

Frames: W is the robot's `base_link` (x forward), T the flange `tool0`, H the hand.
At q = 0 the arm is stretched along +x of W.  With the tool pointing down, the arm
moves in a vertical plane that shoulder pan q1 turns about z of W:

* u = (cos q1, sin q1, 0) points from the shoulder to the hand, n = z x u sideways;
* wrist 3's axis stands d4 from that plane along n, and d5 beyond wrist 1 along u;
* the hand's heading is q1 + HAND_TURN - q6: wrist 3 turns the other way, 1:1.

Needs NumPy alone, and takes tens of microseconds.
"""

import math
from typing import Final

import numpy as np

from rhp_drake.errors import InputError

# UR5, CB3 "serie 3", from Universal Robots' article on DH parameters: a (m), d (m),
# alpha (rad) of each joint.
DH_PARAMETERS: Final = np.array(
    [
        [0.0, 0.089159, math.pi / 2],
        [-0.425, 0.0, 0.0],
        [-0.39225, 0.0, 0.0],
        [0.0, 0.10915, math.pi / 2],
        [0.0, 0.09465, -math.pi / 2],
        [0.0, 0.0823, 0.0],
    ]
)
TOOL_LENGTH: Final = 0.15  # m from the flange to H, as in hand.sdf.
WRIST_LIMIT: Final = 2 * math.pi  # rad, either way.

# Because wrist 3 stands beside the arm's plane, pan goes from -74 to 39 degrees in
# the task's workspace.  The hand is bolted on turned by this much, which centres
# pan's share of wrist 3's range: a heading up to 300 degrees either way fits.
HAND_TURN: Final = math.radians(17.5)

# Height of H, the fingers' lower edge, above the table while pushing.
PUSHING_HEIGHT: Final = 0.005  # m

_D1, _D4, _D5, _D6 = DH_PARAMETERS[[0, 3, 4, 5], 1].tolist()
_UPPER_ARM, _FOREARM = (-DH_PARAMETERS[[1, 2], 0]).tolist()
_ALPHA_COSINES = np.round(np.cos(DH_PARAMETERS[:, 2])).tolist()
_ALPHA_SINES = np.round(np.sin(DH_PARAMETERS[:, 2])).tolist()
_A = DH_PARAMETERS[:, 0].tolist()
_D = DH_PARAMETERS[:, 1].tolist()

# The hand in the flange: the tool's length along z of T, half a turn about x (z of
# T points down, of H up), and HAND_TURN less the quarter turn between T and the arm.
_PSI = -math.pi / 2 - HAND_TURN
_X_TH: Final = np.array(
    [
        [math.cos(_PSI), math.sin(_PSI), 0, 0],
        [math.sin(_PSI), -math.cos(_PSI), 0, 0],
        [0, 0, -1, TOOL_LENGTH],
        [0, 0, 0, 1],
    ]
)


def forward_kinematics(q: np.ndarray) -> np.ndarray:
    """The hand's pose X_WH, a homogeneous matrix of shape (4, 4), m.

    Args:
        q: Joint positions, shape (6,), rad.
    """
    # `base`, where the DH chain starts, is W turned by half a turn about z.
    X = np.diag([-1.0, -1.0, 1.0, 1.0])
    for i, angle in enumerate(q):
        c, s = math.cos(angle), math.sin(angle)
        ca, sa = _ALPHA_COSINES[i], _ALPHA_SINES[i]
        X = X @ np.array(
            [
                [c, -s * ca, s * sa, _A[i] * c],
                [s, c * ca, -c * sa, _A[i] * s],
                [0, sa, ca, _D[i]],
                [0, 0, 0, 1],
            ]
        )
    return X @ _X_TH


def hand_pose(q: np.ndarray) -> np.ndarray:
    """Planar pose (x, y, heading) of the hand in W, shape (3,), m and rad.

    The heading is unwrapped: of the angles that the hand's x axis has, the one that
    the joints have turned to.

    Args:
        q: Joint positions that hold the tool about vertical, shape (6,), rad.
    """
    X_WH = forward_kinematics(q)
    heading = math.atan2(X_WH[1, 0], X_WH[0, 0])
    turned = q[0] + HAND_TURN - q[5]
    heading += 2 * math.pi * round((turned - heading) / (2 * math.pi))
    return np.array([X_WH[0, 3], X_WH[1, 3], heading])


def inverse_kinematics(
    hand_pose: np.ndarray, height: float = PUSHING_HEIGHT
) -> np.ndarray:
    """Joint positions, shape (6,), that hold the hand upright at a planar pose.

    Always the same branch, which is continuous over the workspace: hand in front of
    the shoulder, elbow up, wrist 2 at -90 degrees.

    Args:
        hand_pose: Planar pose (x, y, heading) of H in W, shape (3,), m and rad.
        height: z of H in W, m.

    Raises:
        InputError: If the arm cannot reach that far or that near, or if wrist 3
            cannot turn that far.
    """
    x, y, heading = map(float, hand_pose)
    where = f"hand pose ({x:.3f}, {y:.3f}, {heading:.3f}) at height {height:.3f}"
    distance = math.hypot(x, y)
    if not distance > _D4:
        raise InputError(f"{where} is too near to the robot's base.")
    pan = math.atan2(y, x) - math.asin(_D4 / distance)

    # Wrist 1 as seen from the shoulder, in the arm's plane.
    along_u = math.sqrt(distance**2 - _D4**2) - _D5
    along_z = height + TOOL_LENGTH + _D6 - _D1
    square = along_u**2 + along_z**2
    elbow_cosine = (square - _UPPER_ARM**2 - _FOREARM**2) / (2 * _UPPER_ARM * _FOREARM)
    if not -1 <= elbow_cosine <= 1:
        raise InputError(f"{where} is out of the arm's reach.")
    elbow = math.acos(elbow_cosine)
    # Lift and elbow turn downwards when positive.
    lift = -math.atan2(along_z, along_u) - math.atan2(
        _FOREARM * math.sin(elbow), _UPPER_ARM + _FOREARM * elbow_cosine
    )
    wrist_3 = pan + HAND_TURN - heading
    if not abs(wrist_3) <= WRIST_LIMIT:
        raise InputError(f"{where} asks more of wrist 3 than its 360 degrees.")
    quarter = math.pi / 2
    return np.array([pan, lift, elbow, -quarter - lift - elbow, -quarter, wrist_3])
