"""Where the time of a push in the push model goes.

What is Python's is timed as it runs.  Drake's steps are told apart by timing their
parts alone: a step in which nothing touches, and the geometry query of a step.  Parts
are too short to wait in them for other processes: all times are the processor's.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import time
from typing import Final

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from rhp_drake.benchmarks.pairs import Pairs
from rhp_drake.benchmarks.push_model import Spread, spread_of
from rhp_drake.physics import ObjectPhysics, nominal_physics
from rhp_drake.push_model.diagram import (
    TIME_STEP,
    MakePushDiagram,
    MakePushSimulator,
)
from rhp_drake.push_model.transition import PushModel

_REPEATS: Final = 9
# Parts are timed in so many of the states after a push.
_STATES: Final = 200
# m: between bodies that do not touch.
_FAR: Final = 1.0


@dataclass(frozen=True)
class Part:
    """A part of a push.

    Attributes:
        name: What it is.
        seconds: Of a push, in one thread.
        share: Of the whole push.
    """

    name: str
    seconds: Spread
    share: Spread


@dataclass(frozen=True)
class Profile:
    """Where the time of a push goes.

    Attributes:
        steps: Of the integrator in a push, mean.
        parts: They add up to the last one, the whole push, but for medians.
    """

    steps: float
    parts: list[Part]


class _TimedPushModel(PushModel):
    """A push model that notes how long its parts take, and counts its steps."""

    def __init__(self, num_objects: int) -> None:
        super().__init__(num_objects)
        self.seconds: dict[str, float] = defaultdict(float)
        self.steps = 0

    def _check(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        physics: Sequence[ObjectPhysics],
    ) -> None:
        begin = time.thread_time()
        super()._check(states, actions, physics)
        self.seconds["checks"] += time.thread_time() - begin

    def _simulate(
        self, simulator: Simulator, state: np.ndarray, result: np.ndarray, touch: float
    ) -> None:
        self.steps -= simulator.get_num_steps_taken()
        begin = time.thread_time()
        super()._simulate(simulator, state, result, touch)
        self.seconds["simulation"] += time.thread_time() - begin
        self.steps += simulator.get_num_steps_taken()


class _Parts:
    """Parts of a push that can be timed alone, in states after pushes."""

    def __init__(self, states: np.ndarray) -> None:
        num_objects = states.shape[1] // 3 - 1
        diagram = MakePushDiagram(num_objects)
        self._simulator = MakePushSimulator(diagram, nominal_physics(num_objects))
        self._plant: MultibodyPlant = diagram.plant()
        self._context = self._simulator.get_mutable_context()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        self._integrator = self._simulator.get_mutable_integrator()
        self._near = [*states[:_STATES]]
        far = np.zeros(states.shape[1])
        far[::3] = _FAR * np.arange(num_objects + 1)
        self._far = [far] * _STATES
        self._zeros = np.zeros(states.shape[1])

    def measure(self) -> dict[str, float]:
        """Each part's time, s."""
        placing = _mean_time(self._place, self._near)
        return {
            "state": _mean_time(self._read_and_write, self._near),
            "free_step": _mean_time(self._step, self._far)
            - _mean_time(self._place, self._far),
            "geometry": _mean_time(self._query, self._near) - placing,
        }

    def _place(self, state: np.ndarray) -> None:
        self._plant.SetPositions(self._plant_context, state)

    def _query(self, state: np.ndarray) -> None:
        self._place(state)
        query = self._plant.get_geometry_query_input_port().Eval(self._plant_context)
        query.ComputePointPairPenetration()

    def _step(self, state: np.ndarray) -> None:
        self._place(state)
        self._simulator.AdvanceTo(self._context.get_time() + TIME_STEP, False)

    def _read_and_write(self, state: np.ndarray) -> None:
        """What a push does beside advancing."""
        both = np.concatenate([state, self._zeros])
        self._plant.GetMyMutableContextFromRoot(self._context)
        self._plant.SetPositionsAndVelocities(self._plant_context, both)
        self._integrator.set_maximum_step_size(TIME_STEP)
        self._plant.SetVelocities(self._plant_context, self._zeros)
        self._integrator.set_maximum_step_size(TIME_STEP)
        self._plant.GetPositions(self._plant_context)


def measure_profile(pairs: Pairs, num_objects: int) -> Profile:
    """Where the time of a push goes, in one thread.

    Args:
        pairs: Contact-rich ones, stepped in one batch.
        num_objects: m.
    """
    states, actions = pairs
    count = len(states)
    model = _TimedPushModel(num_objects)
    parts = _Parts(model.step(states, actions))
    turns = []
    for _ in range(_REPEATS):
        model.seconds.clear()
        model.steps = 0
        begin = time.thread_time()
        model.step(states, actions)
        whole = (time.thread_time() - begin) / count
        checks = model.seconds["checks"] / count
        simulation = model.seconds["simulation"] / count
        steps = model.steps / count
        alone = parts.measure()
        geometry = steps * alone["geometry"]
        machinery = steps * alone["free_step"] - geometry
        turns.append(
            {
                "checks of the input": checks,
                "swept test, rest of the batch": whole - checks - simulation,
                "setting and reading states": alone["state"],
                "steps: poses and geometry query": geometry,
                "steps: rest, if nothing touched": machinery,
                "steps: contact": simulation - alone["state"] - geometry - machinery,
                "whole push": whole,
            }
        )
    return Profile(
        steps,
        [
            Part(
                name,
                spread_of(np.array([turn[name] for turn in turns])),
                spread_of(
                    np.array([turn[name] / turn["whole push"] for turn in turns])
                ),
            )
            for name in turns[0]
        ],
    )


def _mean_time(
    function: Callable[[np.ndarray], None], states: Sequence[np.ndarray]
) -> float:
    """Of the function in a state, s."""
    begin = time.thread_time()
    for state in states:
        function(state)
    return (time.thread_time() - begin) / len(states)
