"""The (state, action) pairs that the push model is measured on."""

import math
from typing import Final, TypeAlias

import numpy as np

from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.task import (
    HAND_ACTIONS,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    object_positions,
    overlapping_bodies,
    sample_instance,
)

# States of shape (N, 3 + 3 m) and actions of shape (N,).
Pairs: TypeAlias = tuple[np.ndarray, np.ndarray]

# m: a box that went less far did not move.
LEAST_MOTION: Final = 1e-3
# m: "near" a box, along either axis.
_NEAR: Final = 0.12
# m: as roll-outs meet them, bodies may as good as touch.
_CLEARANCE: Final = 0.001


def sample_mixed_pairs(count: int, num_objects: int, seed: int) -> Pairs:
    """Random tasks' initial states with random actions; most touch nothing."""
    generator = stream(seed, "bench_push_model", "mixed", num_objects)
    states = [
        sample_instance(generator, num_objects).initial_state for _ in range(count)
    ]
    return np.array(states), generator.choice(HAND_ACTIONS, size=count)


def sample_contact_pairs(count: int, num_objects: int, seed: int) -> Pairs:
    """Pairs with the hand near some box and an action that moves a box."""
    generator = stream(seed, "bench_push_model", "contact", num_objects)
    push_model = PushModel(num_objects)
    states: list[np.ndarray] = []
    actions: list[int] = []
    while len(states) < count:
        state = _sample_scene(generator, num_objects)
        box = object_positions(state)[generator.integers(num_objects)]
        state[:2] = box + generator.uniform(-_NEAR, _NEAR, size=2)
        action = int(generator.choice(HAND_ACTIONS))
        if overlapping_bodies(state, _CLEARANCE):
            continue
        after = push_model.step(state[None], np.array([action]))[0]
        if distances(after, state).max() > LEAST_MOTION:
            states.append(state)
            actions.append(action)
    return np.array(states), np.array(actions)


def _sample_scene(generator: np.random.Generator, num_objects: int) -> np.ndarray:
    """A state with boxes anywhere and the hand far away.

    Boxes come one by one: ten at once would hardly ever fit.
    """
    state = np.array([10.0, 10.0, generator.uniform(-math.pi, math.pi)])
    while len(state) < 3 + 3 * num_objects:
        x, y = generator.uniform(WORKSPACE_LOWER, WORKSPACE_UPPER)
        box = [x, y, generator.uniform(-math.pi, math.pi)]
        if not overlapping_bodies(np.append(state, box), _CLEARANCE):
            state = np.append(state, box)
    return state


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of each object between its places in states (..., 3 + 3 m): (..., m), m."""
    offsets = object_positions(a) - object_positions(b)
    return np.hypot(offsets[..., 0], offsets[..., 1])


def errors_of_moved(
    states: np.ndarray, results: np.ndarray, references: np.ndarray
) -> list[np.ndarray]:
    """For each pair, how far the boxes that either result moves are apart, m."""
    moved = (distances(results, states) > LEAST_MOTION) | (
        distances(references, states) > LEAST_MOTION
    )
    return [e[i] for e, i in zip(distances(results, references), moved, strict=True)]
