"""RHP-66 in worlds that are not quite the push model it plans with."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from rhp_drake.benchmarks.decision import make_rhp66
from rhp_drake.benchmarks.engines import PUSH_MODEL, make_engine
from rhp_drake.benchmarks.push_model import FINE
from rhp_drake.evaluation.episode import Episode, run_episode
from rhp_drake.evaluation.world import PlanarWorld
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.planning.receding_horizon import RecedingHorizon, TransitionFunction
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.weights import load_q_network
from rhp_drake.workers import run_over


@dataclass(frozen=True)
class World:
    """Where actions are executed.

    Attributes:
        engine: One of `engines.available_engines`.
        refinement: How many times more steps than usual.
    """

    engine: str
    refinement: int


@dataclass(frozen=True)
class WorldTrial:
    """RHP-66 in a world, on a validation instance."""

    world: World
    index: int


def worlds_of(engines: Sequence[str]) -> list[World]:
    """The push model itself, first, and all engines at their finest."""
    return [World(PUSH_MODEL, 1), *(World(engine, FINE) for engine in engines)]


@lru_cache(maxsize=1)
def _policy(weights: Path) -> RecedingHorizon:
    return make_rhp66(load_q_network(weights, NUM_OBJECTS), PushModel(NUM_OBJECTS))


@lru_cache(maxsize=8)
def _engine(world: World) -> TransitionFunction:
    return make_engine(world.engine, NUM_OBJECTS, world.refinement)


def _run_trial(trial: WorldTrial, weights: Path) -> Episode:
    instance = load_instances(VALIDATION)[trial.index]
    world = PlanarWorld(_engine(trial.world).step, instance)
    return run_episode(world, _policy(weights), instance, 0, trial.index)


def run_in_worlds(
    worlds: Sequence[World], weights: Path, num_instances: int, num_workers: int
) -> Iterator[tuple[WorldTrial, Episode]]:
    """Runs RHP-66 on the first validation instances in each world.

    Args:
        worlds: See `worlds_of`.
        weights: File of the Q-network's weights.
        num_instances: How many.
        num_workers: Processes; the episodes are the same whatever their number.
    """
    trials = [WorldTrial(w, i) for i in range(num_instances) for w in worlds]
    return run_over(partial(_run_trial, weights=weights), trials, num_workers)
