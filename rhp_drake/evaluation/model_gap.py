"""How far apart the push model and the station are, in single actions."""

from collections.abc import Iterator
from dataclasses import dataclass
import logging
from typing import Final

import numpy as np

from rhp_drake.evaluation.station_world import MakeStationSimulator, StationWorld
from rhp_drake.evaluation.world import WorldError
from rhp_drake.physics import nominal_physics
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.task import (
    NUM_ACTIONS,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    Action,
    TaskInstance,
    allowed_actions,
    object_positions,
    overlapping_bodies,
    sample_instance,
)

_logger = logging.getLogger("rhp_drake")

# m: the hand starts at most this far from the target...
_REACH: Final = 0.12
# ...and the push model must see a box move at least this far.
_LEAST_MOTION: Final = 0.005


@dataclass(frozen=True)
class Push:
    """One action in both worlds.

    Attributes:
        action: The action.
        state: Before it, shape (3 + 3 m,).
        push_model_state: After it in the push model.
        station_state: After it in the station.
    """

    action: Action
    state: np.ndarray
    push_model_state: np.ndarray
    station_state: np.ndarray

    def displacement_errors(self) -> np.ndarray:
        """Distances between the worlds of the objects that either moved, m."""
        return _distances(self.push_model_state, self.station_state)[self._moved()]

    def displacements(self) -> np.ndarray:
        """How far the same objects moved in the station, m."""
        return _distances(self.state, self.station_state)[self._moved()]

    def _moved(self) -> np.ndarray:
        """Which objects moved in either world, booleans of shape (m,)."""
        ends = (self.push_model_state, self.station_state)
        return np.any(
            [_distances(self.state, end) > _LEAST_MOTION for end in ends], axis=0
        )


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of each object between its places in two states, shape (m,), m."""
    offsets = object_positions(a) - object_positions(b)
    return np.hypot(offsets[:, 0], offsets[:, 1])


def _sample_push(
    push_model: PushModel, generator: np.random.Generator
) -> tuple[TaskInstance, Action, np.ndarray]:
    """Draws a task and an action that moves a box, and where the model says to."""
    while True:
        instance = sample_instance(generator, push_model.num_objects)
        state = instance.initial_state.copy()
        state[:2] = state[3:5] + generator.uniform(-_REACH, _REACH, size=2)
        action = Action(int(generator.integers(NUM_ACTIONS)))
        inside = (state[:2] > WORKSPACE_LOWER) & (state[:2] < WORKSPACE_UPPER)
        if (
            not inside.all()
            or overlapping_bodies(state, 0.002)
            or not allowed_actions(state)[action]
        ):
            continue
        after = push_model.step(state[None], np.array([action]))[0]
        motion = object_positions(after) - object_positions(state)
        if np.linalg.norm(motion, axis=1).max() > _LEAST_MOTION:
            return TaskInstance(state, instance.goals), action, after


def compare_pushes(num_pushes: int, seed: int, num_objects: int = 3) -> Iterator[Push]:
    """Executes random pushes in the push model and in the station.

    Args:
        num_pushes: How many.
        seed: Of the pushes.
        num_objects: m.
    """
    push_model = PushModel(num_objects)
    simulator = MakeStationSimulator()
    for index in range(num_pushes):
        instance, action, expected = _sample_push(
            push_model, stream(seed, VALIDATION, "model_gap", index)
        )
        world = StationWorld(simulator, instance, nominal_physics(num_objects))
        try:
            world.reset()
            world.step(action)
        except WorldError as error:
            # What was measured is worth more than this one.
            _logger.warning("push %d is left out: %s", index, error)
            continue
        yield Push(action, instance.initial_state, expected, world.state)
