"""Policies side by side on the same task instances, in worlds of the same physics."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import Episode, run_episode
from rhp_drake.evaluation.world import (
    PlanarWorld,
    World,
    WorldFactory,
    load_world_factory,
)
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.physics import UNCERTAINTY_LEVELS, ObjectPhysics, draw_physics
from rhp_drake.planning.policy import Policy
from rhp_drake.planning.policy_config import (
    GreedyConfig,
    MakePolicy,
    PolicyConfig,
    RecedingHorizonConfig,
    named_policy,
)
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import stream
from rhp_drake.resources import resolve
from rhp_drake.systems.receding_horizon_planner import MAX_SEED
from rhp_drake.task import TaskInstance
from rhp_drake.workers import Workers, run_over

if TYPE_CHECKING:
    from pydrake.systems.analysis import Simulator

PLANAR: Final = "planar"
STATION: Final = "station"
# Instances that are run and stored together, as many as in the paper's batches.
BATCH_SIZE: Final = 20


@dataclass(frozen=True, order=True)
class Column:
    """A policy with its Q-network: what the paper's table has a column of.

    Attributes:
        policy: Its name, see `policy_config.named_policy`.
        weights: Name of its Q-network's weights, "" if it has none.
    """

    policy: str
    weights: str

    def __str__(self) -> str:
        return f"{self.policy} {self.weights}".strip()


@dataclass(frozen=True)
class Trial:
    """One policy on one instance, in a world of the physics drawn for this trial.

    Attributes:
        column: The policy.
        level: How much the world's physics differ from what the policy believes.
        index: Of the instance in its set.
        number: Which of the trials on this instance.
    """

    column: Column
    level: str
    index: int
    number: int


@dataclass(frozen=True)
class Batch:
    """Trials that are run and stored together.

    Attributes:
        column: Of all of them.
        level: Of all of them.
        number: Of all of them.
        indices: Of the instances.
    """

    column: Column
    level: str
    number: int
    indices: range

    def trials(self) -> list[Trial]:
        """The trials, by instance."""
        return [Trial(self.column, self.level, i, self.number) for i in self.indices]


@dataclass(frozen=True)
class Experiment:
    """What to compare.

    Attributes:
        columns: The policies.
        levels: Of the physics' uncertainty, any of `UNCERTAINTY_LEVELS`.
        instances: Name of a set of instances.
        num_objects: Of each instance.
        num_instances: The first so many of the set.
        num_trials: On each instance.
        world: "planar", the push model; "station", the whole robot; or a factory of
            worlds, see `world.load_world_factory`.
        seed: Of the policies' random draws, and of the physics.
    """

    columns: dict[Column, PolicyConfig]
    levels: Sequence[str]
    instances: str
    num_objects: int
    num_instances: int
    num_trials: int
    world: str
    seed: int

    def __post_init__(self) -> None:
        for level in self.levels:
            if level not in UNCERTAINTY_LEVELS:
                known = ", ".join(UNCERTAINTY_LEVELS)
                raise InputError(f"{level!r} is not a level of uncertainty: {known}.")
        if self.num_objects != NUM_OBJECTS and self.world == STATION:
            raise InputError(
                f"the station has {NUM_OBJECTS} objects, not {self.num_objects}."
            )
        if ":" in self.world:
            load_world_factory(self.world)
        elif self.world not in (PLANAR, STATION):
            raise InputError(
                f"{self.world!r} is not a world: {PLANAR}, {STATION}, or "
                "package.module:factory."
            )
        available = len(load_instances(self.instances, self.num_objects))
        if not 1 <= self.num_instances <= available:
            raise InputError(
                f"{self.num_instances} instances were asked for; the {self.instances} "
                f"set has {available}."
            )
        # Else weights for other numbers of objects are found out after hours.
        for config in self.columns.values():
            MakePolicy(config, self.num_objects)

    def batches(self) -> list[Batch]:
        """All of them, whole trials one after the other, so that early ends count."""
        return [
            Batch(column, level, number, range(first, last))
            for number in range(self.num_trials)
            for column in self.columns
            for level in self.levels
            for first in range(0, self.num_instances, BATCH_SIZE)
            for last in [min(first + BATCH_SIZE, self.num_instances)]
        ]


def make_columns(
    policies: Sequence[str], weights: Sequence[str], temperature: float | None = None
) -> dict[Column, PolicyConfig]:
    """Each policy with each of the weights, if it has a Q-network.

    Args:
        policies: Names, see `policy_config.named_policy`.
        weights: Names of weights that come with the package, or files.
        temperature: Of the policies that have one; None for their own.

    Raises:
        InputError: If a name is unknown, or two files have the same name.
    """
    files = {_weights_name(name): _weights_uri(name) for name in weights}
    if len(files) < len(weights):
        raise InputError(f"two of the weights have the same name: {','.join(weights)}.")
    columns: dict[Column, PolicyConfig] = {}
    # All policies of one Q-network side by side, as in the paper's table.
    for file_name, uri in files.items():
        for policy in policies:
            config = named_policy(policy)
            if temperature is not None and isinstance(config, RecedingHorizonConfig):
                config.temperature = temperature
            column = Column(policy, "")
            if isinstance(config, RecedingHorizonConfig | GreedyConfig):
                config.q_network = uri
                column = Column(policy, file_name)
            config.validate()
            columns[column] = config
    return columns


def _weights_name(name: str) -> str:
    return Path(name).stem


def _weights_uri(name: str) -> str:
    """Of the weights of this name that come with the package, else the file's path."""
    uri = f"package://rhp_drake/q_network/{name}.safetensors"
    if resolve(uri).is_file():
        return uri
    if not Path(name).is_file():
        raise InputError(f"{name}: there is no such file of weights.")
    return name


def run_batch(batch: Batch, experiment: Experiment) -> list[Episode]:
    """Runs the trials of a batch, in order.

    An episode depends on experiment and trial alone, but for its times and for whether
    they reach a limit.
    """
    instances = load_instances(experiment.instances, experiment.num_objects)
    return [
        _run_trial(trial, instances[trial.index], experiment)
        for trial in batch.trials()
    ]


def run_batches(
    experiment: Experiment, batches: Sequence[Batch], workers: Workers
) -> Iterator[tuple[Batch, list[Episode]]]:
    """Runs batches of an experiment, and yields each as it is done."""
    return run_over(partial(run_batch, experiment=experiment), batches, workers)


# What a process keeps from batch to batch: it is dear to make.
_policies: dict[str, Policy] = {}
_push_model = cache(PushModel)


@cache
def _station_simulator() -> "Simulator":
    from rhp_drake.evaluation.station_world import MakeStationSimulator

    return MakeStationSimulator()


def _path(trial: Trial) -> tuple[str | int, ...]:
    """Names a trial's random streams; all policies meet the same world."""
    return trial.index, "trial", trial.number


def drawn_physics(trial: Trial, instance: TaskInstance, seed: int) -> ObjectPhysics:
    """The physics of a trial's world.

    Args:
        trial: Which.
        instance: Its instance.
        seed: Of the experiment.
    """
    # The same draws at each level, more or less spread.
    generator = stream(seed, *_path(trial), "world_physics")
    return draw_physics(trial.level, instance.initial_state, generator)


def _run_trial(trial: Trial, instance: TaskInstance, experiment: Experiment) -> Episode:
    m, seed = experiment.num_objects, experiment.seed
    path = _path(trial)
    physics = drawn_physics(trial, instance, seed)
    world_seed = int(stream(seed, *path, "world").integers(MAX_SEED))
    key = f"{m} {experiment.columns[trial.column]!r}"
    if key not in _policies:
        _policies[key] = MakePolicy(experiment.columns[trial.column], m)
    policy = _policies[key]
    make_world = _WORLDS.get(experiment.world) or load_world_factory(experiment.world)
    world = make_world(instance, physics, world_seed)
    return run_episode(world, policy, instance, seed, *path)


def _make_planar_world(
    instance: TaskInstance, physics: ObjectPhysics, seed: int
) -> World:
    push_model = _push_model(instance.num_objects)
    return PlanarWorld(partial(push_model.step, physics=physics), instance)


def _make_station_world(
    instance: TaskInstance, physics: ObjectPhysics, seed: int
) -> World:
    from rhp_drake.evaluation.station_world import StationWorld

    return StationWorld(_station_simulator(), instance, physics)


_WORLDS: Final[dict[str, WorldFactory]] = {
    PLANAR: _make_planar_world,
    STATION: _make_station_world,
}
