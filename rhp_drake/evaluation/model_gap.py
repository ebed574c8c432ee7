"""How far apart the push model and the station are, in single actions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydrake.systems.analysis import Simulator

from rhp_drake.closed_loop import MakeClosedLoop, run_closed_loop
from rhp_drake.physics import nominal_physics
from rhp_drake.planning.policy import Decision, PolicyError
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.scenario import Scenario
from rhp_drake.task import (
    NUM_ACTIONS,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    Action,
    TaskInstance,
    allowed_actions,
    goals_reached,
    object_positions,
    overlapping_bodies,
    sample_instance,
)

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
        start = object_positions(self.state)
        ends = [
            object_positions(self.push_model_state),
            object_positions(self.station_state),
        ]
        moved = [np.linalg.norm(end - start, axis=1) > _LEAST_MOTION for end in ends]
        return np.linalg.norm(ends[0] - ends[1], axis=1)[moved[0] | moved[1]]


@dataclass(frozen=True)
class _OneAction:
    """The policy that executes one action and gives up."""

    action: Action

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        if memory is not None:
            raise PolicyError("the action is done.")
        return Decision(self.action, float("nan"), memory="done")


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
        # A task that the action completes would end before the action is done.
        if np.linalg.norm(motion, axis=1).max() > _LEAST_MOTION and not goals_reached(
            after, instance.goals
        ):
            return TaskInstance(state, instance.goals), action, after


def compare_pushes(num_pushes: int, seed: int, num_objects: int = 3) -> Iterator[Push]:
    """Executes random pushes in the push model and in the station.

    Args:
        num_pushes: How many.
        seed: Of the pushes.
        num_objects: m.
    """
    push_model = PushModel(num_objects)
    simulators = {
        action: Simulator(MakeClosedLoop(Scenario(), _OneAction(action)))
        for action in Action
    }
    for index in range(num_pushes):
        instance, action, expected = _sample_push(
            push_model, stream(seed, VALIDATION, "model_gap", index)
        )
        simulator = simulators[action]
        run_closed_loop(simulator, instance, nominal_physics(num_objects), seed=0)
        state = simulator.get_system().GetOutputPort("state")
        yield Push(
            action,
            instance.initial_state,
            expected,
            state.Eval(simulator.get_context()).copy(),
        )
