"""The transition function T of the paper's MDP: batches of pushes, in threads.

The hand's motion is prescribed: it cannot be stopped, and ends exactly at its
target.  Until it first touches an object nothing else moves, so an action is
simulated from the first touch on, and not at all if nothing is touched.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from threading import Lock
from types import TracebackType
from typing import Any, Final

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.physics import ObjectPhysics, nominal_physics
from rhp_drake.push_model.diagram import (
    TIME_STEP,
    MakePushDiagram,
    MakePushSimulator,
)
from rhp_drake.push_model.touch import (
    PARTS_PER_PIECE,
    STEPS_PER_ACTION,
    first_touches,
    overlaps_deeply,
)
from rhp_drake.task import Action, hand_targets

_DURATION: Final = STEPS_PER_ACTION * TIME_STEP  # s
# Time steps in which the hand stands at its target, taken as one: contact is found at
# the beginning of a step, so the last one of the motion may leave an overlap.
_SETTLING_STEPS: Final = 4
# Each with its own physics.
_SIMULATORS_PER_THREAD: Final = 32


class PushModelError(ValueError):
    """A transition cannot be computed; the message names its state."""


class PushModel:
    """Steps batches of (state, action) pairs.

    Each thread owns a simulator, with its own context of the diagram for its number of
    objects, for each of the latest physics it met.  A transition depends on its own
    state, action and physics alone, so results are the same bits whatever the batch and
    the number of threads.  (Drake's batch evaluation would clone a context at every
    call, which costs more than a transition.)

    It may be shared: of several Python threads that step it, one steps at a time, since
    Drake simulates without Python's lock.  A copy, also one that was pickled, makes
    simulators of its own.

    Args:
        num_objects: The largest m that it can step.
        num_threads: Threads to spread a batch over.
        refinement: Time steps for each piece of a path, whose times must add up as
            those of `TIME_STEP` do; 1 is the push model, 20 a finer reference.
    """

    def __init__(
        self, num_objects: int, num_threads: int = 1, refinement: float = 1
    ) -> None:
        self.num_objects = num_objects
        self._time_step = TIME_STEP / refinement
        self._num_threads = num_threads
        self._prepare()

    def _prepare(self) -> None:
        """Makes what cannot be copied."""
        n = self._num_threads
        self._simulators: list[dict[bytes, Simulator]] = [{} for _ in range(n)]
        self._threads = ThreadPoolExecutor(n - 1) if n > 1 else None
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        own = ("_simulators", "_threads", "_lock")
        return {name: value for name, value in vars(self).items() if name not in own}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._prepare()

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
        num_threads = max(1, min(self._num_threads, len(columns)))

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
        with self._lock:
            if self._threads is not None:
                jobs = [
                    self._threads.submit(simulate, k) for k in range(1, num_threads)
                ]
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
            begin += min(TIME_STEP, self._time_step) / PARTS_PER_PIECE
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
