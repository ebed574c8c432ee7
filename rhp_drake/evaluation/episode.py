"""One closed-loop run of a policy in the planar world."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
import time
from typing import Protocol

import numpy as np

from rhp_drake.evaluation.failure import describe_ending
from rhp_drake.physics import ObjectPhysics
from rhp_drake.planning.policy import Policy, PolicyError
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import MAX_ACTIONS, TaskInstance, goals_reached, objects_fallen
from rhp_drake.value.q_network import QNetwork


class PlanarWorld(Protocol):
    """Whatever executes actions as the push model does, e.g. a `PushModel`."""

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The states (N, 3 + 3 m) after the actions (N,)."""
        ...


@dataclass(frozen=True)
class PushWorld:
    """The push model as a world whose physics the planner may not know.

    Attributes:
        push_model: Simulates it.
        physics: Of the objects.
    """

    push_model: PushModel
    physics: ObjectPhysics

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """See `PlanarWorld`."""
        return self.push_model.step(states, actions, self.physics)


@dataclass(frozen=True)
class Episode:
    """How a run went.

    Attributes:
        outcome: "succeeded", "out of actions", "object fell", "policy failed", "world
            failed", and in the station whatever else stopped it.
        num_actions: Actions executed.
        decision_seconds: Computation of each decision.
        simulated_seconds: How long it took in the world; 0 where time does not flow.
        world_seconds: Computation of the world.
        ending: How it ended, in words, if it failed; see `failure.describe_ending`.
    """

    outcome: str
    num_actions: int
    decision_seconds: list[float] = field(default_factory=list)
    simulated_seconds: float = 0.0
    world_seconds: float = 0.0
    ending: str = ""

    @property
    def succeeded(self) -> bool:
        """Whether every object ended in its goal region."""
        return self.outcome == "succeeded"


def run_episode(
    world: PlanarWorld, policy: Policy, instance: TaskInstance, seed: int, index: int
) -> Episode:
    """Runs a policy on an instance until it ends (section VII of the paper).

    Args:
        world: Where the actions are executed; the policy has its own model.
        policy: Chooses them.
        instance: What to do.
        seed: Of the experiment.
        index: Of the instance; decision k draws from stream (index, "decision", k).
    """
    states, goals = [instance.initial_state], instance.goals
    memory = None
    seconds: list[float] = []

    def failed(outcome: str, num_actions: int) -> Episode:
        ending = describe_ending(states, goals)
        return Episode(outcome, num_actions, seconds, ending=ending)

    for k in range(MAX_ACTIONS):
        begin = time.perf_counter()
        try:
            decision = policy.decide(
                states[-1], goals, stream(seed, index, "decision", k), memory
            )
        except (PolicyError, PushModelError):
            return failed("policy failed", k)
        seconds.append(time.perf_counter() - begin)
        memory = decision.memory
        try:
            state = world.step(states[-1][None], np.array([decision.action]))[0]
        except PushModelError:
            return failed("world failed", k + 1)
        states.append(state)
        if objects_fallen(state):
            return failed("object fell", k + 1)
        if goals_reached(state, goals):
            return Episode("succeeded", k + 1, seconds)
    return failed("out of actions", MAX_ACTIONS)


def greedy_episodes(
    network: QNetwork, instances: Sequence[TaskInstance]
) -> list[Episode]:
    """Runs the greedy policy of a Q-network on each instance, in the push model."""
    world = PushModel(network.num_objects)
    # A state at a time is nothing for a GPU.
    policy = RecedingHorizon(world, deepcopy(network).cpu(), 0, 0, 1.0)
    return [
        run_episode(world, policy, instance, 0, index)
        for index, instance in enumerate(instances)
    ]
