"""One closed-loop run of a policy in a world."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
import time
from typing import Final

import numpy as np

from rhp_drake.errors import InputError, WorkError
from rhp_drake.evaluation.failure import describe_ending
from rhp_drake.evaluation.world import PlanarWorld, Step, World, WorldError
from rhp_drake.planning.policy import Policy, PolicyError
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import MAX_ACTIONS, TaskInstance, goals_reached, objects_fallen
from rhp_drake.value.q_network import QNetwork

# s of computation, of policy and world together; section VII-B.
TIME_LIMIT: Final = 120.0
SUCCEEDED: Final = "succeeded"


@dataclass(frozen=True)
class Episode:
    """How a run went.

    Attributes:
        outcome: "succeeded", "out of actions", "out of time", "object fell", "policy
            failed", "world failed", and in the station whatever else stopped it.
        actions: Those executed, L of them.
        states: Before each action and at the end, shape (L + 1, 3 + 3 m); the last one
            is not there if the world failed.
        decision_seconds: Computation of each decision.
        world_seconds: Computation of the world.
        simulated_seconds: How long it took in the world; 0 where time does not flow.
        ending: How it ended, in words, if it failed; see `failure.describe_ending`.
    """

    outcome: str
    actions: Sequence[int]
    states: np.ndarray
    decision_seconds: Sequence[float] = field(default_factory=list)
    world_seconds: float = 0.0
    simulated_seconds: float = 0.0
    ending: str = ""

    @property
    def succeeded(self) -> bool:
        """Whether every object ended in its goal region."""
        return self.outcome == SUCCEEDED

    @property
    def num_actions(self) -> int:
        """L."""
        return len(self.actions)

    @property
    def seconds(self) -> float:
        """Computation of policy and world."""
        return sum(self.decision_seconds) + self.world_seconds


def run_episode(
    world: World, policy: Policy, instance: TaskInstance, seed: int, *path: str | int
) -> Episode:
    """Runs a policy on an instance until it ends (section VII of the paper).

    Args:
        world: Where the actions are executed; the policy has its own model.
        policy: Chooses them.
        instance: What to do.
        seed: Of the experiment.
        path: Names the run; decision k draws from stream (*path, "decision", k).

    Raises:
        InputError: If the world shows states of another shape than the instance's.
        WorkError: If the world cannot even begin: that says nothing of the policy.
    """
    goals = instance.goals
    try:
        world.reset()
        states = [_seen(world, instance)]
    except WorldError as error:
        name = type(world).__name__
        raise WorkError(f"the world {name} cannot be reset: {error}") from error
    actions: list[int] = []
    seconds: list[float] = []
    world_seconds = 0.0
    memory = None
    outcome = "out of actions"
    while len(actions) < MAX_ACTIONS:
        if sum(seconds) + world_seconds > TIME_LIMIT:
            outcome = "out of time"
            break
        generator = stream(seed, *path, "decision", len(actions))
        begin = time.perf_counter()
        try:
            decision = policy.decide(states[-1], goals, generator, memory)
        except (PolicyError, PushModelError):
            outcome = "policy failed"
            break
        decided = time.perf_counter()
        seconds.append(decided - begin)
        memory = decision.memory
        actions.append(decision.action)
        try:
            world.step(decision.action)
            states.append(_seen(world, instance))
        except WorldError:
            outcome = "world failed"
            break
        world_seconds += time.perf_counter() - decided
        if objects_fallen(states[-1]):
            outcome = "object fell"
            break
        if goals_reached(states[-1], goals):
            outcome = SUCCEEDED
            break
    ending = "" if outcome == SUCCEEDED else describe_ending(states, goals)
    return Episode(
        outcome, actions, np.array(states), seconds, world_seconds, ending=ending
    )


def _seen(world: World, instance: TaskInstance) -> np.ndarray:
    """A copy of the world's state.

    Raises:
        InputError: If it has another shape than the instance's.
        WorldError: If it is not finite.
    """
    state = np.array(world.state, dtype=float)
    if state.shape != instance.initial_state.shape:
        raise InputError(
            f"the world {type(world).__name__} shows a state of shape {state.shape}; "
            f"the instance's has {instance.initial_state.shape}."
        )
    if not np.isfinite(state).all():
        raise WorldError("the state is not finite.")
    return state


def run_episodes(
    step: Step, policy: Policy, instances: Sequence[TaskInstance]
) -> Iterator[Episode]:
    """Runs a policy on each instance in turn, in planar worlds, under seed 0.

    Args:
        step: The worlds' transition function, see `PlanarWorld`.
        policy: Chooses the actions.
        instances: What to do.
    """
    for index, instance in enumerate(instances):
        yield run_episode(PlanarWorld(step, instance), policy, instance, 0, index)


def greedy_episodes(
    network: QNetwork, instances: Sequence[TaskInstance]
) -> list[Episode]:
    """Runs the greedy policy of a Q-network on each instance, in the push model."""
    push_model = PushModel(network.num_objects)
    # A state at a time is nothing for a GPU.
    policy = RecedingHorizon(push_model, deepcopy(network).cpu(), 0, 0, 1.0)
    return list(run_episodes(push_model.step, policy, instances))
