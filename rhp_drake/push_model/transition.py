"""The transition function T of the paper's MDP: batches of pushes on cloned contexts.

The hand's motion is prescribed: it cannot be stopped, and ends exactly at its
target.  Until it first touches an object nothing else moves, so an action is
simulated from just before the first touch on, and not at all if nothing is touched.
"""

from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Final

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.planar_geometry import rectangles_overlap
from rhp_drake.push_model.diagram import TIME_STEP, MakePushContext, MakePushDiagram
from rhp_drake.task import (
    ACTION_DISPLACEMENTS,
    BOX_SIDE,
    HAND_RECTANGLES,
    NUM_ACTIONS,
    hand_targets,
)

# An action's path is cut into this many equal pieces; each is one time step.
STEPS_PER_ACTION: Final = 10
# Time steps in which the hand stands at its target: contact is found at the beginning
# of a step, so the last one of the motion may leave an overlap.
_SETTLING_STEPS: Final = 1
# m: what two bodies at rest in contact may overlap, an error of the contact solver.
_CONTACT_TOLERANCE: Final = 2e-4


class PushModelError(RuntimeError):
    """The physics of one transition failed; the message names its state."""


def _swept_rectangles() -> np.ndarray:
    """What each piece of each action's path sweeps, in the frame H of its start.

    Returns:
        Shape (6, STEPS_PER_ACTION, 3, 5): rectangles of `planar_geometry` that
        cover the hand's three during that piece.
    """
    half_step = 0.5 / STEPS_PER_ACTION
    fractions = np.arange(STEPS_PER_ACTION) / STEPS_PER_ACTION + half_step
    swept = np.empty((NUM_ACTIONS, STEPS_PER_ACTION, len(HAND_RECTANGLES), 5))
    radius = np.linalg.norm(
        np.abs(HAND_RECTANGLES[:, :2]) + HAND_RECTANGLES[:, 2:], axis=1
    )
    for action, displacement in enumerate(ACTION_DISPLACEMENTS):
        for i, fraction in enumerate(fractions):
            x, y, theta = fraction * displacement
            c, s = np.cos(theta), np.sin(theta)
            hand = HAND_RECTANGLES
            swept[action, i, :, 0] = x + c * hand[:, 0] - s * hand[:, 1]
            swept[action, i, :, 1] = y + s * hand[:, 0] + c * hand[:, 1]
            swept[action, i, :, 2] = theta
            # A translation along an own axis sweeps just a longer rectangle; in a
            # rotation no point strays from its midway place by more than its arc.
            growth = np.abs(half_step * displacement)
            swept[action, i, :, 3] = hand[:, 2] + growth[0] + growth[2] * radius
            swept[action, i, :, 4] = hand[:, 3] + growth[1] + growth[2] * radius
    return swept


_SWEPT_RECTANGLES: Final = _swept_rectangles()


def first_touches(states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The piece of each action's path in which the hand first touches an object.

    Args:
        states: Shape (N, 3 + 3 m).
        actions: Integers of shape (N,).

    Returns:
        Integers of shape (N,), `STEPS_PER_ACTION` where nothing is touched.
    """
    hand, objects = states[:, :3], states[:, 3:].reshape(len(states), -1, 3)
    # Objects as squares in the frame H of the action's start, which is where the
    # table of swept rectangles lives.
    offsets = objects[..., :2] - hand[:, None, :2]
    c, s = np.cos(hand[:, None, 2]), np.sin(hand[:, None, 2])
    half = np.full(objects.shape[:2], BOX_SIDE / 2 - _CONTACT_TOLERANCE)
    squares = np.stack(
        [
            c * offsets[..., 0] + s * offsets[..., 1],
            c * offsets[..., 1] - s * offsets[..., 0],
            objects[..., 2] - hand[:, None, 2],
            half,
            half,
        ],
        axis=-1,
    )
    overlaps = rectangles_overlap(
        _SWEPT_RECTANGLES[actions][:, :, :, None], squares[:, None, None]
    )
    touched = np.any(overlaps, axis=(2, 3))
    return np.where(touched.any(axis=1), touched.argmax(axis=1), STEPS_PER_ACTION)


class PushModel:
    """Steps batches of (state, action) pairs.

    Each thread owns a clone of one context, made once; a transition depends on its
    own state and action alone, so results are the same bits whatever the batch and
    the number of threads.

    Args:
        num_objects: m.
        num_threads: C++ threads to spread a batch over.
        refinement: Time steps for each piece of a path; 1 is the push model, more
            is a finer reference.
    """

    def __init__(
        self, num_objects: int, num_threads: int = 1, refinement: int = 1
    ) -> None:
        self.num_objects = num_objects
        self._refinement = refinement
        self._time_step = TIME_STEP / refinement
        self.diagram = MakePushDiagram(num_objects, self._time_step)
        self._plant = self.diagram.plant()
        context = MakePushContext(self.diagram)
        self._simulators = [
            Simulator(self.diagram, context.Clone()) for _ in range(num_threads)
        ]
        self._threads = ThreadPoolExecutor(num_threads) if num_threads > 1 else None

    def __enter__(self) -> "PushModel":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._threads is not None:
            self._threads.shutdown()

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The states in which everything rests after the actions.

        Args:
            states: Shape (N, 3 + 3 m).
            actions: Integers of shape (N,).

        Returns:
            The next states, shape (N, 3 + 3 m).

        Raises:
            ValueError: If a shape is wrong or a state is not finite.
            PushModelError: If the contact solver fails.
        """
        self._check(states, actions)
        results = states.copy()
        results[:, :3] = hand_targets(states, actions)
        touches = first_touches(states, actions)
        columns = np.flatnonzero(touches < STEPS_PER_ACTION)
        if self._threads is None or len(columns) < 2:
            self._simulate(self._simulators[0], columns, states, touches, results)
        else:
            # Interleaved, so that each thread gets its share of the long ones.
            share = len(self._simulators)
            jobs = [
                self._threads.submit(
                    self._simulate,
                    simulator,
                    columns[i::share],
                    states,
                    touches,
                    results,
                )
                for i, simulator in enumerate(self._simulators)
            ]
            for job in jobs:
                job.result()
        return results

    def _simulate(
        self,
        simulator: Simulator,
        columns: np.ndarray,
        states: np.ndarray,
        touches: np.ndarray,
        results: np.ndarray,
    ) -> None:
        """Writes the objects' poses in the given columns of `results`."""
        context = simulator.get_mutable_context()
        plant_context = self._plant.GetMyMutableContextFromRoot(context)
        num_positions = states.shape[1]
        start = np.zeros(2 * num_positions)
        rest = np.zeros(num_positions)
        duration = STEPS_PER_ACTION * TIME_STEP
        for column in columns:
            start[:num_positions] = states[column]
            motion = results[column, :3] - states[column, :3]
            start[:3] += motion * (touches[column] / STEPS_PER_ACTION)
            start[num_positions : num_positions + 3] = motion / duration
            steps = (STEPS_PER_ACTION - touches[column]) * self._refinement
            try:
                context.SetTime(0.0)
                self._plant.SetPositionsAndVelocities(plant_context, start)
                simulator.Initialize()
                # Half a step less than so many periods: exactly so many updates,
                # whatever the rounding.
                simulator.AdvanceTo((steps - 0.5) * self._time_step, False)
                # The hand stands; what it still overlaps comes out.
                self._plant.SetVelocities(plant_context, rest)
                steps += _SETTLING_STEPS * self._refinement
                simulator.AdvanceTo((steps - 0.5) * self._time_step, False)
            except (RuntimeError, SystemExit) as error:
                # Drake's assertions arrive as SystemExit.
                raise PushModelError(
                    f"the push model failed from state {states[column].tolist()} "
                    f"with the hand going to {results[column, :3].tolist()}: {error}"
                ) from error
            results[column, 3:] = self._plant.GetPositions(plant_context)[3:]

    def _check(self, states: np.ndarray, actions: np.ndarray) -> None:
        size = 3 + 3 * self.num_objects
        if states.ndim != 2 or states.shape[1] != size:
            raise ValueError(
                f"states must have shape (N, {size}) for {self.num_objects} objects, "
                f"not {states.shape}."
            )
        if actions.shape != states.shape[:1]:
            raise ValueError(
                f"{len(states)} states need as many actions, not {actions.shape}."
            )
        bad = np.flatnonzero(~np.isfinite(states).all(axis=1))
        if len(bad):
            raise ValueError(f"state {bad[0]} of the batch is not finite.")
