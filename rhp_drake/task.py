"""The task: the Markov decision process of section III of the paper.

A *state* is a vector of shape (3 + 3 m,): the planar pose (x, y, theta) of the hand
H, then that of each of the m objects, in metres and radians in the world frame W.
W stands at the robot's base, x forward, z up, and z = 0 is the table's top.  Object
0 is the target, the others are obstacles.  Functions ending in an `s` of states take
batches of shape (N, 3 + 3 m).

The hand's heading theta is *unwrapped*: it counts turns, because the wrist does.

This module needs NumPy alone.
"""

from dataclasses import dataclass
import enum
import math
from typing import Final

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.planar_geometry import rectangles_overlap

BOX_SIDE: Final = 0.06  # m, section VII of the paper.
GOAL_RADIUS: Final = 0.06  # m, section VII.
MAX_ACTIONS: Final = 40  # Section VII.
REWARD: Final = -1.0  # Per action, section III.
# What a state is worth from which the goal is never reached within the limit of
# actions; no state is worth less.
FAILURE_VALUE: Final = REWARD * MAX_ACTIONS
TRANSLATION: Final = 0.05  # m per action, section VII.
ROTATION: Final = math.pi / 6  # rad per action, section VII.

# The hand is three rectangles in H: the palm and two fingers, an opening of 0.10 m,
# wider than a box's diagonal (0.085 m).  H stands in the middle of the opening, x
# out of it.  Columns: centre x, centre y, half length along x, half length along y.
HAND_RECTANGLES: Final = np.array(
    [
        [-0.05, 0.0, 0.01, 0.07],
        [0.0, 0.06, 0.04, 0.01],
        [0.0, -0.06, 0.04, 0.01],
    ]
)

# Where the origin of H may be: a UR5 with a tool of 0.15 m reaches all of it, at
# every heading.
WORKSPACE_LOWER: Final = np.array([0.20, -0.30])
WORKSPACE_UPPER: Final = np.array([0.80, 0.30])
# m: an arm that is not exact may be sent this far out, and may still turn this far out.
_BORDER_TOLERANCE: Final = 0.001
_TURNING_TOLERANCE: Final = 0.005
# Wrist 3 turns within +-360 degrees, of which shoulder pan's part (up to 57 degrees
# either way in this workspace) is not the hand's to use.
MAX_HEADING: Final = math.radians(300)

# The table's top.  An object whose centre leaves it has fallen.
TABLE_LOWER: Final = np.array([0.10, -0.40])
TABLE_UPPER: Final = np.array([0.90, 0.40])

# Sampled tasks keep this much away from the workspace's border...
_BOX_BORDER: Final = 0.03
_GOAL_BORDER: Final = 0.05
# ...and this much, in metres, between any two bodies.
_CLEARANCE: Final = 0.005
# How often the bodies are placed anew until they do not overlap.  Twelve objects take
# some 400 trials, sixteen 25000.
_MAX_TRIALS: Final = 100_000
# Objects that are looked at first, whatever their number: so many never fit.
_FIRST_OBJECTS: Final = 30


class Action(enum.IntEnum):
    """Translations along the axes of the hand H or of the world W, and rotations."""

    FORWARD = 0
    BACKWARD = 1
    LEFT = 2
    RIGHT = 3
    COUNTERCLOCKWISE = 4
    CLOCKWISE = 5
    WORLD_PLUS_X = 6
    WORLD_MINUS_X = 7
    WORLD_PLUS_Y = 8
    WORLD_MINUS_Y = 9


# The paper's six actions are four translations in "the cardinal directions" and two
# rotations.  It does not say whose directions: a policy uses one of these sets.  The
# hand's are the default, since plans are shorter with them (rhp bench action-frames).
HAND_ACTIONS: Final = np.array([0, 1, 2, 3, 4, 5])
WORLD_ACTIONS: Final = np.array([6, 7, 8, 9, 4, 5])
NUM_ACTIONS: Final = 6

_FIRST_WORLD_ACTION: Final = int(Action.WORLD_PLUS_X)
# Displacement (x, y, theta) of the hand by each action, along the axes it is named for.
_DISPLACEMENTS: Final = np.array(
    [
        [TRANSLATION, 0, 0],
        [-TRANSLATION, 0, 0],
        [0, TRANSLATION, 0],
        [0, -TRANSLATION, 0],
        [0, 0, ROTATION],
        [0, 0, -ROTATION],
        [TRANSLATION, 0, 0],
        [-TRANSLATION, 0, 0],
        [0, TRANSLATION, 0],
        [0, -TRANSLATION, 0],
    ]
)


@dataclass(frozen=True)
class TaskInstance:
    """A task instance <s_init, G> (section III).

    Attributes:
        initial_state: Shape (3 + 3 m,).
        goals: Centres of the circular goal regions, shape (m, 2), m in W.  Each has
            the radius `GOAL_RADIUS`; an obstacle's stands where the obstacle starts.
    """

    initial_state: np.ndarray
    goals: np.ndarray

    def __post_init__(self) -> None:
        m = len(self.goals)
        if self.goals.shape != (m, 2) or self.initial_state.shape != (3 + 3 * m,):
            raise ValueError(
                f"goals of shape {self.goals.shape} need an initial state of shape "
                f"({3 + 3 * m},), not {self.initial_state.shape}."
            )

    @property
    def num_objects(self) -> int:
        """m, the target included."""
        return len(self.goals)


def object_positions(states: np.ndarray) -> np.ndarray:
    """Positions (..., m, 2) of the objects in states of shape (..., 3 + 3 m)."""
    num_objects = states.shape[-1] // 3 - 1  # No -1 below: N may be 0.
    return states[..., 3:].reshape(*states.shape[:-1], num_objects, 3)[..., :2]


def goals_reached(states: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Whether every object's centre is inside its goal region: S_goal, section III.

    Args:
        states: Shape (..., 3 + 3 m).
        goals: Shape (..., m, 2), broadcast against the states.

    Returns:
        Booleans of shape (...).
    """
    offsets = object_positions(states) - goals
    return (np.linalg.norm(offsets, axis=-1) <= GOAL_RADIUS).all(axis=-1)


def objects_fallen(states: np.ndarray) -> np.ndarray:
    """Whether any object's centre is off the table, shape (...)."""
    positions = object_positions(states)
    off = (positions < TABLE_LOWER) | (positions > TABLE_UPPER)
    return np.any(off, axis=(-1, -2))


def hand_targets(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Poses (..., 3) of the hand after the actions; nothing stops the hand.

    Args:
        states: Shape (..., 3 + 3 m), or (..., 3) for the hand's pose alone.
        actions: Integers of shape (...).
    """
    d = _DISPLACEMENTS[actions]
    x, y, theta = states[..., 0], states[..., 1], states[..., 2]
    along_hand = np.asarray(actions) < _FIRST_WORLD_ACTION
    c = np.where(along_hand, np.cos(theta), 1.0)
    s = np.where(along_hand, np.sin(theta), 0.0)
    return np.stack(
        [
            x + c * d[..., 0] - s * d[..., 1],
            y + s * d[..., 0] + c * d[..., 1],
            theta + d[..., 2],
        ],
        axis=-1,
    )


def allowed_actions(
    states: np.ndarray, action_set: np.ndarray = HAND_ACTIONS
) -> np.ndarray:
    """Which actions keep the hand in the workspace, booleans of shape (..., A).

    Roll-outs, learning and execution all take their mask from here.

    Args:
        states: Shape (..., 3 + 3 m).
        action_set: The A actions to look at, integers of shape (A,).
    """
    targets = hand_targets(states[..., None, :3], action_set)
    turns = (_DISPLACEMENTS[action_set, :2] == 0).all(axis=-1, keepdims=True)
    tolerance = np.where(turns, _TURNING_TOLERANCE, _BORDER_TOLERANCE)
    inside = (targets[..., :2] >= WORKSPACE_LOWER - tolerance) & (
        targets[..., :2] <= WORKSPACE_UPPER + tolerance
    )
    return inside.all(axis=-1) & (np.abs(targets[..., 2]) <= MAX_HEADING)


def state_rectangles(state: np.ndarray) -> np.ndarray:
    """The hand's three rectangles and each object's nominal square in W.

    Args:
        state: Shape (3 + 3 m,).

    Returns:
        Shape (3 + m, 5): centre x, y, angle, half lengths along the own axes.
    """
    x, y, theta = state[:3]
    c, s = math.cos(theta), math.sin(theta)
    hand = HAND_RECTANGLES
    rows = [
        [x + c * r[0] - s * r[1], y + s * r[0] + c * r[1], theta, r[2], r[3]]
        for r in hand
    ]
    half = BOX_SIDE / 2
    rows += [[*pose, half, half] for pose in state[3:].reshape(-1, 3)]
    return np.array(rows)


def overlapping_bodies(state: np.ndarray, clearance: float = 0.0) -> list[str]:
    """Names the pairs of bodies closer than `clearance` (m), none if all is well.

    Bodies are called "hand" and "object i".
    """
    rectangles = state_rectangles(state)
    rectangles[:, 3:] += clearance / 2
    names = ["hand"] * len(HAND_RECTANGLES)
    names += [f"object {i}" for i in range(len(rectangles) - len(names))]
    pairs = [
        f"{names[i]} and {names[j]}"
        for i in range(len(rectangles))
        for j in range(max(i + 1, len(HAND_RECTANGLES)), len(rectangles))
        if rectangles_overlap(rectangles[i], rectangles[j])
    ]
    return list(dict.fromkeys(pairs))


def sample_instance(
    generator: np.random.Generator, num_objects: int = 3
) -> TaskInstance:
    """Draws a random task instance, as section VII-A does.

    Hand, objects and the target's goal are uniform over the workspace (less a
    border); bodies do not overlap, and the goal is not met at the start.

    Raises:
        InputError: If so many objects do not fit, as far as trying tells.
    """
    for _ in range(_MAX_TRIALS):
        hand = [
            *generator.uniform(WORKSPACE_LOWER, WORKSPACE_UPPER),
            generator.uniform(-math.pi, math.pi),
        ]
        boxes = np.column_stack(
            [
                generator.uniform(
                    WORKSPACE_LOWER + _BOX_BORDER,
                    WORKSPACE_UPPER - _BOX_BORDER,
                    size=(num_objects, 2),
                ),
                generator.uniform(-math.pi, math.pi, size=num_objects),
            ]
        )
        goals = boxes[:, :2].copy()
        goals[0] = generator.uniform(
            WORKSPACE_LOWER + _GOAL_BORDER, WORKSPACE_UPPER - _GOAL_BORDER
        )
        state = np.concatenate([hand, boxes.ravel()])
        if (
            not _too_close(boxes[:_FIRST_OBJECTS, :2])
            and not overlapping_bodies(state, _CLEARANCE)
            and not goals_reached(state, goals)
        ):
            return TaskInstance(state, goals)
    raise InputError(
        f"{num_objects} objects do not fit: they overlapped in each of {_MAX_TRIALS} "
        "random arrangements in the workspace."
    )


def _too_close(positions: np.ndarray) -> bool:
    """Whether any two of the boxes' centres (k, 2) are so close that they overlap.

    Others may, too; but this is soon told.
    """
    x, y = positions.T
    squares = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2
    # Each is close to itself.
    return bool((squares < BOX_SIDE**2).sum() > len(positions))
