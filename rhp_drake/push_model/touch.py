"""Where the hand first touches objects, by geometry alone: until there no physics."""

from typing import Final

import numpy as np

from rhp_drake.physics import SIDE_RANGE
from rhp_drake.planar_geometry import rectangles_overlap
from rhp_drake.task import BOX_SIDE, HAND_RECTANGLES, hand_targets

# An action's path is cut into this many equal pieces; each takes one time step.
STEPS_PER_ACTION: Final = 10
# The piece in which something is touched is cut again.
PARTS_PER_PIECE: Final = 4
# m: bodies this far inside each other were put there by mistake.  Pushed ones stay
# below 1 cm, which it takes two boxes jammed between the fingers to reach; but a
# planner that believes in nominal boxes may see smaller ones closer than those can be.
_DEEP_OVERLAP: Final = BOX_SIDE - SIDE_RANGE[0] + 0.005
# The hand's rectangles as `planar_geometry` wants them, in H.
_HAND_IN_H: Final = np.insert(HAND_RECTANGLES, 2, 0.0, axis=1)
# How far each of the hand's rectangles reaches from H, m.
_REACH: Final = np.linalg.norm(
    np.abs(HAND_RECTANGLES[:, :2]) + HAND_RECTANGLES[:, 2:], axis=1
)
# m: what two bodies at rest in contact may overlap, an error of the contact solver.
_CONTACT_TOLERANCE: Final = 2e-4


def _swept_rectangles(
    motions: np.ndarray, middles: np.ndarray, length: float
) -> np.ndarray:
    """Rectangles that cover what the hand sweeps in pieces of its path.

    Args:
        motions: Displacements of the hand in the frame H of its start, shape (N, 3).
        middles: Where the pieces have their middles, in [0, 1], shape (N or 1, K).
        length: Of a piece; the path's is 1.

    Returns:
        Rectangles of `planar_geometry` in that frame, shape (N, K, 3, 5).
    """
    x, y, theta = np.moveaxis(middles[..., None] * motions[:, None], -1, 0)[..., None]
    c, s = np.cos(theta), np.sin(theta)
    hand = HAND_RECTANGLES.T
    swept = np.empty((*theta.shape[:2], len(HAND_RECTANGLES), 5))
    swept[..., 0] = x + c * hand[0] - s * hand[1]
    swept[..., 1] = y + s * hand[0] + c * hand[1]
    swept[..., 2] = theta
    # Half a piece before and after the middle of the piece; in a rotation no point
    # strays from there by more than its arc.
    growth = np.abs(motions)[:, None] * (length / 2)
    turn = growth[..., 2:] * _REACH
    # A translation oblique to the hand's axes is covered with some room to spare.
    swept[..., 3] = hand[2] + growth[..., :1] + turn
    swept[..., 4] = hand[3] + growth[..., 1:2] + turn
    return swept


def first_touches(
    states: np.ndarray, actions: np.ndarray, side_lengths: np.ndarray
) -> np.ndarray:
    """How far the hand goes for sure before it touches an object.

    Args:
        states: Shape (N, 3 + 3 m).
        actions: Integers of shape (N,).
        side_lengths: Of the boxes, shape (N, m, 2), m.

    Returns:
        Pieces of the path, whole ones and parts of `1 / PARTS_PER_PIECE`, of shape
        (N,); `STEPS_PER_ACTION` where nothing is touched.
    """
    hand, objects = states[:, :3], states[:, 3:].reshape(len(states), -1, 3)
    # All in the frame H of the action's start.
    offsets = objects[..., :2] - hand[:, None, :2]
    c, s = np.cos(hand[:, None, 2]), np.sin(hand[:, None, 2])
    boxes = np.concatenate(
        [
            (c * offsets[..., 0] + s * offsets[..., 1])[..., None],
            (c * offsets[..., 1] - s * offsets[..., 0])[..., None],
            (objects[..., 2] - hand[:, None, 2])[..., None],
            side_lengths / 2 - _CONTACT_TOLERANCE,
        ],
        axis=-1,
    )
    motions = hand_targets(states, actions) - hand
    c, s = c[:, 0], s[:, 0]
    motions = np.column_stack(
        [
            c * motions[:, 0] + s * motions[:, 1],
            c * motions[:, 1] - s * motions[:, 0],
            motions[:, 2],
        ]
    )
    everywhere = np.zeros((1, 1))
    pieces = _first_touched(motions, boxes, everywhere, 1.0, STEPS_PER_ACTION)
    touched = pieces < STEPS_PER_ACTION
    begins = pieces[touched, None] / STEPS_PER_ACTION
    length = 1 / STEPS_PER_ACTION
    parts = _first_touched(
        motions[touched], boxes[touched], begins, length, PARTS_PER_PIECE
    )
    touches = pieces.astype(float)
    touches[touched] += parts / PARTS_PER_PIECE
    return touches


def _first_touched(
    motions: np.ndarray,
    boxes: np.ndarray,
    begins: np.ndarray,
    length: float,
    count: int,
) -> np.ndarray:
    """Which of the `count` equal pieces of a stretch of the path touches a box first.

    Args:
        motions: Displacements of the hand in the frame H of its start, shape (N, 3).
        boxes: Rectangles of `planar_geometry` in that frame, shape (N, m, 5).
        begins: Where the stretches begin, in [0, 1], shape (N or 1, 1).
        length: Of the stretches; the path's is 1.
        count: Pieces of a stretch.

    Returns:
        Integers of shape (N,), `count` where none does.
    """
    middles = begins + (np.arange(count) + 0.5) * (length / count)
    swept = _swept_rectangles(motions, middles, length / count)
    overlaps = rectangles_overlap(swept[:, :, :, None], boxes[:, None, None])
    touched = np.any(overlaps, axis=(2, 3))
    return np.where(touched.any(axis=1), touched.argmax(axis=1), count)


def overlaps_deeply(states: np.ndarray, side_lengths: np.ndarray) -> np.ndarray:
    """Whether bodies are further inside each other than a push could leave them.

    Args:
        states: Shape (N, 3 + 3 m).
        side_lengths: Shape (N, m, 2).

    Returns:
        Booleans of shape (N,).
    """
    depth = _DEEP_OVERLAP / 2
    objects = states[:, 3:].reshape(len(states), -1, 3)
    boxes = np.concatenate([objects, side_lengths / 2 - depth], axis=-1)
    hand = np.broadcast_to(_HAND_IN_H, (len(states), *_HAND_IN_H.shape)).copy()
    c, s = np.cos(states[:, None, 2]), np.sin(states[:, None, 2])
    x, y = _HAND_IN_H[:, 0], _HAND_IN_H[:, 1]
    hand[..., 0] = states[:, None, 0] + c * x - s * y
    hand[..., 1] = states[:, None, 1] + s * x + c * y
    hand[..., 2] = states[:, None, 2]
    hand[..., 3:] -= depth
    with_hand = rectangles_overlap(hand[:, :, None], boxes[:, None])
    first, second = np.triu_indices(boxes.shape[1], 1)
    with_boxes = rectangles_overlap(boxes[:, first], boxes[:, second])
    return np.any(with_hand, axis=(1, 2)) | np.any(with_boxes, axis=1)
