"""One closed-loop run of a policy in a world."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
import time
from typing import Final

import numpy as np

from rhp_drake.errors import InputError, WorkError
from rhp_drake.evaluation.failure import cause_of_failure, describe_ending
from rhp_drake.evaluation.world import PlanarWorld, Step, World, WorldError
from rhp_drake.planning.policy import PlanEndedError, Policy, PolicyError
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import MAX_ACTIONS, TaskInstance, goals_reached, objects_fallen
from rhp_drake.value.q_network import QNetwork

# s of computation, of policy and world together; section VII-B.
TIME_LIMIT: Final = 120.0
SUCCEEDED: Final = "succeeded"
OBJECT_FELL: Final = "object fell"
WORLD_FAILED: Final = "world failed"


@dataclass(frozen=True)
class Episode:
    """How a run went.

    Attributes:
        outcome: "succeeded"; "obstacle moved" where the target is home at the end and
            an obstacle is not; else what ended the run: "out of actions", "out of
            time", "plan ended", "policy failed", "object fell" or "world failed".
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
    try:
        world.reset()
        so_far = _SoFar([_seen(world, instance)])
    except WorldError as error:
        name = type(world).__name__
        raise WorkError(f"the world {name} cannot be reset: {error}") from error
    outcome, problem = _play(world, policy, instance, seed, path, so_far)
    ending = ""
    if outcome != SUCCEEDED:
        last = so_far.states[-1]
        if outcome not in (OBJECT_FELL, WORLD_FAILED):
            outcome = cause_of_failure(outcome, last, instance.goals)
        described = describe_ending(so_far.states, instance.goals)
        ending = " ".join(filter(None, [problem, described]))
    return Episode(
        outcome,
        so_far.actions,
        np.array(so_far.states),
        so_far.decision_seconds,
        so_far.world_seconds,
        # Only worlds in which time flows have one.
        getattr(world, "simulated_seconds", 0.0),
        ending,
    )


@dataclass
class _SoFar:
    """A run as far as it has come; see `Episode`."""

    states: list[np.ndarray]
    actions: list[int] = field(default_factory=list)
    decision_seconds: list[float] = field(default_factory=list)
    world_seconds: float = 0.0


def _play(
    world: World,
    policy: Policy,
    instance: TaskInstance,
    seed: int,
    path: tuple[str | int, ...],
    so_far: _SoFar,
) -> tuple[str, str]:
    """Runs until the end; returns what ended it, and in words if something failed."""
    memory = None
    while len(so_far.actions) < MAX_ACTIONS:
        if sum(so_far.decision_seconds) + so_far.world_seconds > TIME_LIMIT:
            return "out of time", ""
        generator = stream(seed, *path, "decision", len(so_far.actions))
        begin = time.perf_counter()
        try:
            decision = policy.decide(
                so_far.states[-1], instance.goals, generator, memory
            )
        except PlanEndedError:
            return "plan ended", ""
        except (PolicyError, PushModelError) as error:
            return "policy failed", str(error)
        decided = time.perf_counter()
        so_far.decision_seconds.append(decided - begin)
        so_far.actions.append(decision.action)
        memory = decision.memory
        try:
            world.step(decision.action)
            so_far.states.append(_seen(world, instance))
        except WorldError as error:
            return WORLD_FAILED, str(error)
        finally:
            so_far.world_seconds += time.perf_counter() - decided
        fallen = objects_fallen(so_far.states[-1])
        if fallen or goals_reached(so_far.states[-1], instance.goals):
            return OBJECT_FELL if fallen else SUCCEEDED, ""
    return "out of actions", ""


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
