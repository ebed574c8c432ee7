"""Kinematics of the UR5 with the hand held upright, nominal or of a particular arm.

Frames: W is the robot's `base_link` (x forward), T the flange `tool0`, H the hand.
At q = 0 the arm is stretched along +x of W.  With the tool pointing down, the arm
moves in a vertical plane that shoulder pan q1 turns about z of W:

* u = (cos q1, sin q1, 0) points from the shoulder to the hand, n = z x u sideways;
* wrist 3's axis stands d4 from that plane along n, and d5 beyond wrist 1 along u;
* the hand's heading is q1 + HAND_TURN - q6: wrist 3 turns the other way, 1:1.

That is the nominal arm, in closed form.  A real one differs by millimetres, as its
factory calibration says; Newton steps bring the closed form there.

Needs NumPy alone.  The nominal arm takes microseconds; the inverse kinematics of
another one take some 0.15 ms.
"""

from dataclasses import dataclass, field
import itertools
import math
from typing import Final

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.task import MAX_HEADING, WORKSPACE_LOWER, WORKSPACE_UPPER

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

# What Newton steps leave of an error, m and rad, and how many they may be: to go some
# millimetres two or three do.
_TOLERANCE: Final = 1e-10
_MOST_STEPS: Final = 8
_LARGEST_STEP: Final = 0.5  # rad; a larger one would leave the branch.
# How far the hand of a particular arm may be from a nominal one's, m and rad.  Factory
# calibrations move it by some millimetres and milliradians.
_LARGEST_OFFSET: Final = 0.03

_OUT_OF_REACH: Final = "is out of the arm's reach."
_BEYOND_WRIST_3: Final = "asks more of wrist 3 than its 360 degrees."


def _zeros() -> list[float]:
    return [0.0] * 6


@dataclass
class DhDeltas:
    """What a particular arm's DH parameters have beyond `DH_PARAMETERS`.

    The names and the numbers are those of `calibration.conf`, the robot's file of its
    factory calibration: parameters of joints 1 to 6, each joint's transform being
    Rz(q + theta) Tz(d) Tx(a) Rx(alpha).  The axes of joints 2, 3 and 4 are almost
    parallel, so that their common normals may be anywhere: d of some hundred metres
    that cancel one another are usual.

    Attributes:
        delta_theta: Offsets of the joints' zeros, rad.
        delta_a: m.
        delta_d: m.
        delta_alpha: rad.
    """

    delta_theta: list[float] = field(default_factory=_zeros)
    delta_a: list[float] = field(default_factory=_zeros)
    delta_d: list[float] = field(default_factory=_zeros)
    delta_alpha: list[float] = field(default_factory=_zeros)

    def validate(self) -> None:
        """Raises an InputError if there are not six numbers, all finite, of each."""
        for name in ("delta_theta", "delta_a", "delta_d", "delta_alpha"):
            values = getattr(self, name)
            if len(values) != 6 or not np.isfinite(values).all():
                raise InputError(
                    f"kinematics.{name} is {values}; it must be six finite numbers."
                )


class Ur5Kinematics:
    """Kinematics of a UR5 that carries the hand.

    Args:
        deltas: The particular arm's; of the nominal arm by default.

    Raises:
        InputError: If the deltas are not six finite numbers each, or if the hand of
            such an arm would be far from a nominal one's, or short of some place in
            the task's workspace.
    """

    def __init__(self, deltas: DhDeltas | None = None) -> None:
        deltas = deltas or DhDeltas()
        deltas.validate()
        self._theta = [float(theta) for theta in deltas.delta_theta]
        self._a = (DH_PARAMETERS[:, 0] + deltas.delta_a).tolist()
        self._d = (DH_PARAMETERS[:, 1] + deltas.delta_d).tolist()
        # Of sums of angles, so that nominal ones have exact zeros and ones.
        cosines = np.round(np.cos(DH_PARAMETERS[:, 2]))
        sines = np.round(np.sin(DH_PARAMETERS[:, 2]))
        c, s = np.cos(deltas.delta_alpha), np.sin(deltas.delta_alpha)
        self._alpha_cosines = (cosines * c - sines * s).tolist()
        self._alpha_sines = (sines * c + cosines * s).tolist()
        self._is_nominal = deltas == DhDeltas()
        if not self._is_nominal:
            self._check_workspace()

    def _check_workspace(self) -> None:
        """Raises an InputError if this cannot be an arm for the task."""
        sides = [
            np.linspace(low, high, 3)
            for low, high in zip(WORKSPACE_LOWER, WORKSPACE_UPPER, strict=True)
        ]
        for x, y, heading in itertools.product(*sides, (-MAX_HEADING, MAX_HEADING)):
            pose = np.array([x, y, heading])
            q = _closed_form(pose, PUSHING_HEIGHT)
            # Not `_error`, which takes half a turn for none.
            moved = self.forward_kinematics(q) - _upright(pose, PUSHING_HEIGHT)
            for offsets, how, unit in (
                (moved[:3, 3], "move", "m"),
                (moved[:3, :3], "turn", "rad"),
            ):
                if not np.abs(offsets).max() <= _LARGEST_OFFSET:
                    raise InputError(
                        f"kinematics: the deltas {how} the hand by more than "
                        f"{_LARGEST_OFFSET} {unit} at ({x:.2f}, {y:.2f}), as no UR5's "
                        "factory calibration does."
                    )
            try:
                self.inverse_kinematics(pose)
            except InputError as refusal:
                raise InputError(
                    "kinematics: with these deltas the arm cannot reach its "
                    f"workspace: {refusal}"
                ) from None

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        """The hand's pose X_WH, a homogeneous matrix of shape (4, 4), m.

        Args:
            q: Joint positions, shape (6,), rad.
        """
        return self._frames(q)[-1]

    def _frames(self, q: np.ndarray) -> list[np.ndarray]:
        """Poses in W, shape (4, 4): of the frame whose z each joint turns about, and H.

        Args:
            q: Joint positions, shape (6,), rad.
        """
        # `base`, where the DH chain starts, is W turned by half a turn about z.
        X = np.diag([-1.0, -1.0, 1.0, 1.0])
        frames = [X]
        for i, angle in enumerate(q):
            turned = angle + self._theta[i]
            c, s = math.cos(turned), math.sin(turned)
            ca, sa = self._alpha_cosines[i], self._alpha_sines[i]
            X = X @ np.array(
                [
                    [c, -s * ca, s * sa, self._a[i] * c],
                    [s, c * ca, -c * sa, self._a[i] * s],
                    [0, sa, ca, self._d[i]],
                    [0, 0, 0, 1],
                ]
            )
            frames.append(X)
        frames[-1] = X @ _X_TH
        return frames

    def hand_pose(self, q: np.ndarray) -> np.ndarray:
        """Planar pose (x, y, heading) of the hand in W, shape (3,), m and rad.

        The heading is unwrapped: of the angles that the hand's x axis has, the one
        that the joints have turned to.

        Args:
            q: Joint positions that hold the tool about vertical, shape (6,), rad.
        """
        X_WH = self.forward_kinematics(q)
        heading = math.atan2(X_WH[1, 0], X_WH[0, 0])
        turned = q[0] + HAND_TURN - q[5]
        heading += 2 * math.pi * round((turned - heading) / (2 * math.pi))
        return np.array([X_WH[0, 3], X_WH[1, 3], heading])

    def inverse_kinematics(
        self, hand_pose: np.ndarray, height: float = PUSHING_HEIGHT
    ) -> np.ndarray:
        """Joint positions, shape (6,), that hold the hand upright at a planar pose.

        Always the same branch, which is continuous over the workspace: hand in front
        of the shoulder, elbow up, wrist 2 near -90 degrees.

        Args:
            hand_pose: Planar pose (x, y, heading) of H in W, shape (3,), m and rad.
            height: z of H in W, m.

        Raises:
            InputError: If the arm cannot reach that far or that near, or if wrist 3
                cannot turn that far.
        """
        q = _closed_form(hand_pose, height)
        if self._is_nominal:
            return q
        X_WH = _upright(hand_pose, height)
        for _ in range(_MOST_STEPS):
            frames = self._frames(q)
            error = _error(frames[-1], X_WH)
            if np.abs(error).max() <= _TOLERANCE:
                if abs(q[5]) <= WRIST_LIMIT:
                    return q
                raise _refusal(hand_pose, height, _BEYOND_WRIST_3)
            try:
                step = np.linalg.solve(_jacobian(frames), error)
            except np.linalg.LinAlgError:
                break
            if not np.abs(step).max() <= _LARGEST_STEP:
                break
            q += step
        raise _refusal(hand_pose, height, _OUT_OF_REACH)


def _closed_form(hand_pose: np.ndarray, height: float) -> np.ndarray:
    """`Ur5Kinematics.inverse_kinematics` of the nominal arm, with the same errors."""
    x, y, heading = map(float, hand_pose)
    distance = math.hypot(x, y)
    if not distance > _D4:
        raise _refusal(hand_pose, height, "is too near to the robot's base.")
    pan = math.atan2(y, x) - math.asin(_D4 / distance)

    # Wrist 1 as seen from the shoulder, in the arm's plane.
    along_u = math.sqrt(distance**2 - _D4**2) - _D5
    along_z = height + TOOL_LENGTH + _D6 - _D1
    square = along_u**2 + along_z**2
    elbow_cosine = (square - _UPPER_ARM**2 - _FOREARM**2) / (2 * _UPPER_ARM * _FOREARM)
    if not -1 <= elbow_cosine <= 1:
        raise _refusal(hand_pose, height, _OUT_OF_REACH)
    elbow = math.acos(elbow_cosine)
    # Lift and elbow turn downwards when positive.
    lift = -math.atan2(along_z, along_u) - math.atan2(
        _FOREARM * math.sin(elbow), _UPPER_ARM + _FOREARM * elbow_cosine
    )
    wrist_3 = pan + HAND_TURN - heading
    if not abs(wrist_3) <= WRIST_LIMIT:
        raise _refusal(hand_pose, height, _BEYOND_WRIST_3)
    quarter = math.pi / 2
    return np.array([pan, lift, elbow, -quarter - lift - elbow, -quarter, wrist_3])


def _refusal(hand_pose: np.ndarray, height: float, reason: str) -> InputError:
    """Says of a hand pose why the arm cannot hold it."""
    x, y, heading = map(float, hand_pose)
    return InputError(
        f"hand pose ({x:.3f}, {y:.3f}, {heading:.3f}) at height {height:.3f} {reason}"
    )


def _upright(hand_pose: np.ndarray, height: float) -> np.ndarray:
    """The pose X_WH, shape (4, 4), of an upright hand."""
    x, y, heading = map(float, hand_pose)
    c, s = math.cos(heading), math.sin(heading)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, height], [0, 0, 0, 1]])


def _error(X_WH: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """What takes one pose to another, shape (6,): m, and rad about W's axes."""
    R = wanted[:3, :3] @ X_WH[:3, :3].T
    x, y, z = wanted[:3, 3] - X_WH[:3, 3]
    # The sine of the angle rather than the angle: they are small.
    a, b, c = (R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2
    return np.array([x, y, z, a, b, c])


def _jacobian(frames: list[np.ndarray]) -> np.ndarray:
    """The geometric Jacobian of the hand, shape (6, 6): a column is `_error` a rad.

    Args:
        frames: From `Ur5Kinematics._frames`.
    """
    *joints, X_WH = frames
    jacobian = np.empty((6, 6))
    axes = np.array([X[:3, 2] for X in joints])
    x, y, z = axes.T
    u, v, w = (X_WH[:3, 3] - np.array([X[:3, 3] for X in joints])).T
    # The axis times the lever, by components: np.cross takes longer than all the rest.
    jacobian[0] = y * w - z * v
    jacobian[1] = z * u - x * w
    jacobian[2] = x * v - y * u
    jacobian[3:] = axes.T
    return jacobian


NOMINAL: Final = Ur5Kinematics()
# The nominal arm's, as the simulated one is.
forward_kinematics = NOMINAL.forward_kinematics
hand_pose = NOMINAL.hand_pose
inverse_kinematics = NOMINAL.inverse_kinematics
