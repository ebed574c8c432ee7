"""The transition function T of the paper's MDP: batches of pushes, in threads.

The hand's motion is prescribed: it cannot be stopped, and ends exactly at its
target.  Until it first touches an object nothing else moves, so an action is
simulated from the first touch on, and not at all if nothing is touched.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from types import TracebackType
from typing import Final

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.physics import SIDE_RANGE, ObjectPhysics, nominal_physics
from rhp_drake.planar_geometry import rectangles_overlap
from rhp_drake.push_model.diagram import (
    TIME_STEP,
    MakePushDiagram,
    MakePushSimulator,
)
from rhp_drake.task import (
    BOX_SIDE,
    HAND_RECTANGLES,
    Action,
    hand_targets,
)

# An action's path is cut into this many equal pieces; each takes one time step.
STEPS_PER_ACTION: Final = 10
_DURATION: Final = STEPS_PER_ACTION * TIME_STEP  # s
# The piece in which something is touched is cut again.
_PARTS_PER_PIECE: Final = 4
# Time steps in which the hand stands at its target, taken as one: contact is found at
# the beginning of a step, so the last one of the motion may leave an overlap.
_SETTLING_STEPS: Final = 4
# Each with its own physics.
_SIMULATORS_PER_THREAD: Final = 32
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


class PushModelError(ValueError):
    """A transition cannot be computed; the message names its state."""


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
        Pieces of the path, whole ones and parts of `1 / _PARTS_PER_PIECE`, of shape
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
        motions[touched], boxes[touched], begins, length, _PARTS_PER_PIECE
    )
    touches = pieces.astype(float)
    touches[touched] += parts / _PARTS_PER_PIECE
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


class PushModel:
    """Steps batches of (state, action) pairs.

    Each thread owns a simulator, with its own context of the one diagram, for each of
    the latest physics it met.  A transition depends on its own state, action and
    physics alone, so results are the same bits whatever the batch and the number of
    threads.  (Drake's batch evaluation would clone a context at every call, which costs
    more than a transition.)

    Args:
        num_objects: The largest m that it can step.
        num_threads: Threads to spread a batch over; Drake simulates without Python's
            lock.
        refinement: Time steps for each piece of a path; 1 is the push model, more
            is a finer reference, less a coarser one.
    """

    def __init__(
        self, num_objects: int, num_threads: int = 1, refinement: float = 1
    ) -> None:
        self.num_objects = num_objects
        self._time_step = TIME_STEP / refinement
        self._simulators: list[dict[bytes, Simulator]] = [
            {} for _ in range(num_threads)
        ]
        self._threads = ThreadPoolExecutor(num_threads - 1) if num_threads > 1 else None

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

    def step(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        physics: ObjectPhysics | Sequence[ObjectPhysics] | None = None,
    ) -> np.ndarray:
        """The states in which everything rests after the actions.

        Args:
            states: Shape (N, 3 + 3 m), of any m up to `num_objects`.
            actions: Integers of shape (N,).
            physics: Of the objects, for all states or for each; nominal if None.

        Returns:
            The next states, shape (N, 3 + 3 m).

        Raises:
            ValueError: If a shape is wrong, or an action is none.
            PushModelError: If a state is not finite or has bodies deep inside each
                other, or the contact solver fails; the message names the state.
        """
        states = np.asarray(states, dtype=float)
        each = _physics_of_each(states, physics)
        if not len(states):
            return states.copy()
        side_lengths = _of_each(each, lambda p: p.side_lengths)
        self._check(states, actions, each)
        results = states.copy()
        results[:, :3] = hand_targets(states, actions)
        touches = first_touches(states, actions, side_lengths)
        columns = np.flatnonzero(touches < STEPS_PER_ACTION)

        # A thread that has nothing to do is not worth waking.
        num_threads = max(1, min(len(self._simulators), len(columns)))

        def simulate(thread: int) -> None:
            # Interleaved, so that each thread gets its share of the long ones.
            for column in columns[thread::num_threads]:
                simulator = self._simulator(thread, each[column])
                try:
                    self._simulate(
                        simulator, states[column], results[column], touches[column]
                    )
                except PushModelError:
                    # The integrator remembers the step in which it failed.
                    self._simulators[thread].clear()
                    raise

        jobs = []
        if self._threads is not None:
            jobs = [self._threads.submit(simulate, k) for k in range(1, num_threads)]
        try:
            simulate(0)
        finally:
            # After a failure, too: nobody else may use the simulators before.
            wait(jobs)
        for job in jobs:
            job.result()
        return results

    def _simulator(self, thread: int, physics: ObjectPhysics) -> Simulator:
        """The thread's simulator for the physics, the least recent one replaced."""
        simulators = self._simulators[thread]
        key = physics.key()
        simulator = simulators.pop(key, None)
        if simulator is None:
            if len(simulators) >= _SIMULATORS_PER_THREAD:
                del simulators[next(iter(simulators))]
            diagram = _push_diagram(physics.num_objects)
            simulator = MakePushSimulator(diagram, physics, self._time_step)
        simulators[key] = simulator
        return simulator

    def _simulate(
        self, simulator: Simulator, state: np.ndarray, result: np.ndarray, touch: float
    ) -> None:
        """Writes the objects' poses of `result`, where the hand has arrived."""
        plant = simulator.get_system().plant()
        context = simulator.get_mutable_context()
        plant_context = plant.GetMyMutableContextFromRoot(context)
        integrator = simulator.get_mutable_integrator()
        begin = touch * TIME_STEP
        if begin > 0:
            # Contact is found at the beginning of a step: the hand begins just inside
            # of what it does not touch from the beginning.
            begin += min(TIME_STEP, self._time_step) / _PARTS_PER_PIECE
        motion = result[:3] - state[:3]
        moving = np.zeros(2 * len(state))
        moving[: len(state)] = state
        moving[:3] += motion * (begin / _DURATION)
        moving[len(state) :][:3] = motion / _DURATION
        try:
            # Time goes on from push to push: setting it back takes an initialization.
            time = context.get_time()
            plant.SetPositionsAndVelocities(plant_context, moving)
            if begin < _DURATION:
                time += _DURATION - begin
                integrator.set_maximum_step_size(self._time_step)
                simulator.AdvanceTo(time, False)
            # The hand stands; what it still overlaps comes out.
            plant.SetVelocities(plant_context, np.zeros(len(state)))
            settling_time = _SETTLING_STEPS * self._time_step
            integrator.set_maximum_step_size(settling_time)
            simulator.AdvanceTo(time + settling_time, False)
        except (RuntimeError, SystemExit) as error:
            # Drake's assertions arrive as SystemExit.
            raise PushModelError(
                f"the push model failed from state {state.tolist()} with the hand "
                f"going to {result[:3].tolist()}: {error}"
            ) from error
        result[3:] = plant.GetPositions(plant_context)[3:]

    def _check(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        physics: Sequence[ObjectPhysics],
    ) -> None:
        m = states.shape[1] // 3 - 1
        if m > self.num_objects:
            raise ValueError(
                f"states of {m} objects in a push model of {self.num_objects}."
            )
        if actions.shape != states.shape[:1]:
            raise ValueError(
                f"{len(states)} states need as many actions, not {actions.shape}."
            )
        bad = np.flatnonzero(~np.isfinite(states).all(axis=1))
        if len(bad):
            raise PushModelError(f"state {bad[0]} of the batch is not finite.")
        if not np.issubdtype(actions.dtype, np.integer):
            raise ValueError(f"actions must be integers, not {actions.dtype}.")
        bad = np.flatnonzero((actions < 0) | (actions >= len(Action)))
        if len(bad):
            raise ValueError(f"action {bad[0]} of the batch is {actions[bad[0]]}.")
        inner_sides = _of_each(physics, lambda p: p.inner_side_lengths())
        bad = np.flatnonzero(overlaps_deeply(states, inner_sides))
        if len(bad):
            raise PushModelError(
                f"state {bad[0]} of the batch, {states[bad[0]].tolist()}, has bodies "
                "deep inside each other."
            )


# Threads may share them: a diagram does not change.
_push_diagram = cache(MakePushDiagram)


@cache
def _nominal_physics(num_objects: int) -> ObjectPhysics:
    return nominal_physics(num_objects)


def _of_each(
    physics: Sequence[ObjectPhysics], get: Callable[[ObjectPhysics], np.ndarray]
) -> np.ndarray:
    """A quantity of each physics, (m, 2) of one, as an array (N, m, 2)."""
    if all(p is physics[0] for p in physics):
        one = get(physics[0])
        return np.broadcast_to(one, (len(physics), *one.shape))
    return np.array([get(p) for p in physics])


def _physics_of_each(
    states: np.ndarray, physics: ObjectPhysics | Sequence[ObjectPhysics] | None
) -> Sequence[ObjectPhysics]:
    """The physics of each state, all of the states' m."""
    if states.ndim != 2 or states.shape[1] % 3 or states.shape[1] < 6:
        raise ValueError(f"states must have shape (N, 3 + 3 m), not {states.shape}.")
    m = states.shape[1] // 3 - 1
    if physics is None:
        physics = _nominal_physics(m)
    if isinstance(physics, ObjectPhysics):
        physics = [physics] * len(states)
    if len(physics) != len(states):
        raise ValueError(f"{len(states)} states need as many physics.")
    for column, of_column in enumerate(physics):
        if of_column.num_objects != m:
            raise ValueError(
                f"physics {column} of the batch is of {of_column.num_objects} objects, "
                f"the states have {m}."
            )
    return physics


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
