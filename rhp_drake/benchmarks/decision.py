"""How long RHP-66 takes to decide, and where the time goes."""

from collections.abc import Sequence
from dataclasses import dataclass
import time
from typing import Any

import numpy as np

from rhp_drake.evaluation.episode import run_episodes
from rhp_drake.physics import ObjectPhysics
from rhp_drake.planning.policy import Decision, PolicyError
from rhp_drake.planning.policy_config import RecedingHorizonConfig
from rhp_drake.planning.receding_horizon import RecedingHorizon, ValueFunction
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.task import TaskInstance
from rhp_drake.value.q_network import QNetwork


@dataclass(frozen=True)
class DecisionTimes:
    """Times of a decision, s.

    Attributes:
        threads: Of the push model.
        decisions: How many were timed.
        p50: Median.
        p95: 95th percentile.
        network: Mean time in the value function.
        contact: Mean time in the push model, less the next one.
        kinematics: Mean time in which the push model, with the hand so far away that
            it touches nothing, steps batches of the same sizes: checks of the states,
            swept test, hand's targets.
        rest: Mean time of the planner itself.
        transitions: Mean number of transitions simulated.
    """

    threads: int
    decisions: int
    p50: float
    p95: float
    network: float
    contact: float
    kinematics: float
    rest: float
    transitions: float


class _TimedNetwork:
    """A value function that notes how long it takes."""

    def __init__(self, network: QNetwork) -> None:
        self._network = network
        self.seconds: list[float] = []

    def values(self, states: np.ndarray, goals: np.ndarray) -> np.ndarray:
        begin = time.perf_counter()
        result = self._network.values(states, goals)
        self.seconds.append(time.perf_counter() - begin)
        return result


class _TimedPushModel(PushModel):
    """A push model that notes how long it takes for how many transitions."""

    def __init__(self, num_objects: int, num_threads: int) -> None:
        super().__init__(num_objects, num_threads)
        self.seconds: list[float] = []
        self.batch_sizes: list[int] = []

    def step(
        self,
        states: np.ndarray,
        actions: np.ndarray,
        physics: ObjectPhysics | Sequence[ObjectPhysics] | None = None,
    ) -> np.ndarray:
        begin = time.perf_counter()
        result = super().step(states, actions, physics)
        self.seconds.append(time.perf_counter() - begin)
        self.batch_sizes.append(len(states))
        return result


class _Bench:
    """RHP-66 with so many threads, and its stopwatches."""

    def __init__(self, network: QNetwork, threads: int) -> None:
        self.threads = threads
        self._network = _TimedNetwork(network)
        self._push_model = _TimedPushModel(network.num_objects, threads)
        self._policy = make_rhp66(self._network, self._push_model)
        self._seconds: list[float] = []

    def decide(self, state: np.ndarray, goals: np.ndarray, index: int) -> None:
        """Times decision `index`; the first one fills caches and is not counted."""
        is_first = not self._push_model.seconds
        generator = stream(0, "bench_push_model", "decision", index)
        begin = time.perf_counter()
        self._policy.decide(state, goals, generator)
        self._seconds.append(time.perf_counter() - begin)
        if is_first:
            self._seconds.clear()
            self._network.seconds.clear()
            self._push_model.batch_sizes.clear()
            self._push_model.seconds[:] = [0.0]

    def summarize(self, state: np.ndarray) -> DecisionTimes:
        """The times so far; `state` is any."""
        count = len(self._seconds)
        network = sum(self._network.seconds) / count
        model = sum(self._push_model.seconds) / count
        batch_sizes = self._push_model.batch_sizes.copy()
        # Nothing within reach of the hand.
        far = state.copy()
        far[:2] += 100.0
        begin = time.perf_counter()
        for size in batch_sizes:
            batch = np.repeat(far[None], size, axis=0)
            self._push_model.step(batch, np.zeros(size, dtype=int))
        kinematics = (time.perf_counter() - begin) / count
        p50, p95 = np.percentile(self._seconds, [50, 95])
        return DecisionTimes(
            self.threads,
            count,
            float(p50),
            float(p95),
            network,
            model - kinematics,
            kinematics,
            sum(self._seconds) / count - network - model,
            sum(batch_sizes) / count,
        )


class _Recorder:
    """The policy, which remembers what it was asked, and gives up after `count`."""

    def __init__(self, policy: RecedingHorizon, count: int) -> None:
        self._policy = policy
        self._count = count
        self.states: list[tuple[np.ndarray, np.ndarray]] = []

    def decide(
        self,
        state: np.ndarray,
        goals: np.ndarray,
        generator: np.random.Generator,
        memory: Any = None,
    ) -> Decision:
        if len(self.states) == self._count:
            raise PolicyError("enough.")
        self.states.append((state, goals))
        return self._policy.decide(state, goals, generator, memory)


def make_rhp66(network: ValueFunction, push_model: PushModel) -> RecedingHorizon:
    """RHP with six roll-outs of six actions, the default."""
    config = RecedingHorizonConfig()
    return RecedingHorizon(
        push_model,
        network,
        config.num_roll_outs,
        config.horizon,
        config.temperature,
    )


def measure_decisions(
    network: QNetwork,
    instances: Sequence[TaskInstance],
    count: int,
    threads: Sequence[int],
) -> list[DecisionTimes]:
    """Times decisions in states that RHP-66 meets itself, thread counts in turns.

    Args:
        network: The value function.
        instances: Where it meets them.
        count: Of decisions, less if the instances do not last.
        threads: Their numbers.
    """
    num_objects = network.num_objects
    recorder = _Recorder(make_rhp66(network, PushModel(num_objects)), count)
    world = PushModel(num_objects)
    for _ in run_episodes(world.step, recorder, instances):
        if len(recorder.states) == count:
            break
    states = recorder.states

    benches = [_Bench(network, n) for n in threads]
    for bench in benches:
        bench.decide(*states[0], 0)
    for index, (state, goals) in enumerate(states):
        for bench in benches:
            bench.decide(state, goals, index)
    return [bench.summarize(states[0][0]) for bench in benches]
