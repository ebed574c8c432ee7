"""What the Q-network sees: the state and the goals, from the hand's point of view.

Seen from the hand, a task and its translated or rotated copy look the same (but for
where the workspace ends), and so does a square turned by 90 degrees.
"""

from typing import Final

import torch

from rhp_drake.task import WORKSPACE_LOWER, WORKSPACE_UPPER

_LENGTH: Final = 0.1  # m: about the size of the hand, so that inputs are near 1.
_CENTRE: Final = tuple((WORKSPACE_LOWER + WORKSPACE_UPPER) / 2)

HAND_FEATURES: Final = 4
OBJECT_FEATURES: Final = 8


def num_features(num_objects: int) -> int:
    """The length of a feature vector."""
    return HAND_FEATURES + OBJECT_FEATURES * num_objects


def features(states: torch.Tensor, goals: torch.Tensor) -> torch.Tensor:
    """Feature vectors of states and goals.

    In the hand's frame H, lengths over 0.1 m: the workspace's centre and heading;
    then for each object its position and distance, cosine and sine of four times its
    angle, and the way to its goal as vector and distance.

    Args:
        states: Shape (N, 3 + 3 m).
        goals: Shape (N, m, 2).

    Returns:
        Shape (N, num_features(m)).
    """
    hand = states[:, None, :3]
    objects = states[:, 3:].unflatten(1, (-1, 3))
    c, s = torch.cos(hand[..., 2]), torch.sin(hand[..., 2])

    def in_hand(vectors: torch.Tensor) -> torch.Tensor:
        x, y = vectors[..., 0], vectors[..., 1]
        return torch.stack([c * x + s * y, c * y - s * x], dim=-1) / _LENGTH

    positions = in_hand(objects[..., :2] - hand[..., :2])
    ways = in_hand(goals - objects[..., :2])
    angles = 4 * (objects[..., 2] - hand[..., 2])
    of_objects = torch.cat(
        [
            positions,
            torch.linalg.vector_norm(positions, dim=-1, keepdim=True),
            torch.cos(angles)[..., None],
            torch.sin(angles)[..., None],
            ways,
            torch.linalg.vector_norm(ways, dim=-1, keepdim=True),
        ],
        dim=-1,
    )
    centre = in_hand(states.new_tensor(_CENTRE) - hand[..., :2]).squeeze(1) / 3
    return torch.cat([centre, c, s, of_objects.flatten(1)], dim=-1)


def object_points(of_objects: torch.Tensor) -> torch.Tensor:
    """Positions and goals in H, over 0.1 m, of objects' features.

    Args:
        of_objects: Shape (..., OBJECT_FEATURES).

    Returns:
        Shape (..., 4).
    """
    positions, ways = of_objects[..., :2], of_objects[..., 5:7]
    return torch.cat([positions, positions + ways], dim=-1)
