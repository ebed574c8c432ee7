"""Variants of reinforcement learning side by side, from the same start and data.

All have half the batch, and RHP acts on half as many tasks a round, as where weights
are made to be used: many trainings fit into the time of one.

A folder holds `settings.json`, what all trainings have in common; `demonstrations`, of
the first training tasks; `plans.parquet`, the plans among them; and for each variant
and seed the weights, whose provenance has the learning curve, once they are done.
"""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from functools import partial
import json
from pathlib import Path
from typing import Any, Final

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import run_episodes
from rhp_drake.evaluation.validation import greedy_successes
from rhp_drake.files import exclusive, write_atomically
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.learning.dataset import load_dataset
from rhp_drake.learning.demonstration_folder import demonstrate_tasks, shard_paths
from rhp_drake.learning.demonstrators import PlanningDemonstrator
from rhp_drake.learning.fitted_q import FittedQ
from rhp_drake.learning.reinforcement import Reinforcement
from rhp_drake.learning.replay import compact, rebuild
from rhp_drake.learning.training import Stepped, make_repeatable, train
from rhp_drake.learning.variants import VARIANTS
from rhp_drake.planning.receding_horizon import RecedingHorizon
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.resources import resolve
from rhp_drake.value.q_network import ARCHITECTURES, QNetwork
from rhp_drake.value.weights import load_q_network, save_q_network
from rhp_drake.workers import run_over

# What imitation of the shipped plans made of each architecture.
STARTS: Final = {
    "paper": "package://rhp_drake/q_network/imitation.safetensors",
    "set": "package://rhp_drake/q_network/imitation_set.safetensors",
}
_SETTINGS: Final = "settings.json"
_DEMONSTRATIONS: Final = "demonstrations"
_NUM_DEMONSTRATIONS: Final = 1000
_PLANS: Final = "plans.parquet"
# Gradient steps between points of a learning curve.
_PERIOD: Final = 2000
_NUM_TASKS: Final = 200


@dataclass(frozen=True)
class Training:
    """One training.

    Attributes:
        variant: Its name in `VARIANTS`.
        seed: Of tasks, policy and batches.
    """

    variant: str
    seed: int


@dataclass(frozen=True)
class TrainingResult:
    """What came of it, on the first `num_tasks` validation tasks.

    Attributes:
        training: Which one.
        curve: Gradient steps, and how many tasks the greedy policy solved then.
        rhp33: How many RHP-33 solves in the end.
        num_tasks: Of how many.
        num_transitions: Of RHP's acting that it learned from.
    """

    training: Training
    curve: tuple[tuple[int, int], ...]
    rhp33: int
    num_tasks: int
    num_transitions: int


@dataclass(frozen=True)
class Trainings:
    """What the trainings of one folder have in common.

    Attributes:
        folder: Where the work is kept.
        num_steps: Gradient steps of each.
        commit: Of the code, to be noted.
    """

    folder: Path
    num_steps: int
    commit: str

    def make(
        self, trainings: Sequence[Training], num_workers: int
    ) -> Iterator[TrainingResult]:
        """Does what the folder lacks; killed at any moment, it goes on where it was.

        Yields:
            The results that were there, then each as it is done.

        Raises:
            InputError: If the folder was made with other settings.
            WorkError: If a worker dies or a file cannot be written.
        """
        with exclusive(self.folder):
            path = self.folder / _SETTINGS
            settings = json.dumps(self._settings()) + "\n"
            if path.exists() and path.read_text() != settings:
                raise InputError(
                    f"{self.folder}: was made with other settings; choose another one."
                )
            write_atomically(path, settings)
            self._make_demonstrations(num_workers)
            missing = []
            for training in trainings:
                if self.weights_path(training).exists():
                    yield self._read(training)
                else:
                    missing.append(training)
            for _, result in run_over(
                partial(_train, trainings=self), missing, num_workers
            ):
                yield result

    def _make_demonstrations(self, num_workers: int) -> None:
        folder, plans = (
            self.data_path(plans_only=False),
            self.data_path(plans_only=True),
        )
        for _ in demonstrate_tasks(
            folder,
            range(_NUM_DEMONSTRATIONS),
            PlanningDemonstrator(0, NUM_OBJECTS),
            num_workers,
            self.commit,
        ):
            pass
        if not plans.exists():
            compact_plans = self.folder / "compact_plans.parquet"
            compact(shard_paths([folder]), compact_plans)
            rebuild(compact_plans, plans)
            compact_plans.unlink()

    def weights_path(self, training: Training) -> Path:
        """Where the weights of a training are once it is done."""
        return self.folder / f"{training.variant}_{training.seed}.safetensors"

    def data_path(self, plans_only: bool) -> Path:
        """Of the demonstrations, or of plans alone."""
        return self.folder / (_PLANS if plans_only else _DEMONSTRATIONS)

    def _settings(self) -> dict[str, Any]:
        starts = [repr(_start(network)) for network in STARTS]
        return {
            "num_steps": self.num_steps,
            "starts": starts,
            "num_demonstrations": _NUM_DEMONSTRATIONS,
            "num_tasks": _NUM_TASKS,
        }

    def _read(self, training: Training) -> TrainingResult:
        path = self.weights_path(training)
        noted = load_q_network(path, NUM_OBJECTS).provenance
        if noted.get("variant") != _describe(training):
            raise InputError(f"{path}: was made by another variant of this name.")
        return TrainingResult(
            training,
            tuple((step, successes) for step, successes in noted["curve"]),
            noted["rhp33"],
            noted["num_tasks"],
            noted["num_transitions"],
        )


def _describe(training: Training) -> dict[str, Any]:
    """What is to be noted of a training's method."""
    return {"name": training.variant, **asdict(VARIANTS[training.variant])}


def _start(architecture: str) -> QNetwork:
    if architecture == "pair":
        pair = ARCHITECTURES["pair"](NUM_OBJECTS)
        for member in pair.members:
            member.load_state_dict(_start("set").state_dict())
        return pair
    return load_q_network(resolve(STARTS[architecture]), NUM_OBJECTS)


def _train(training: Training, trainings: Trainings) -> TrainingResult:
    """Trains, evaluates, and writes the weights."""
    device = make_repeatable(training.seed)
    variant = VARIANTS[training.variant]
    if variant.from_scratch:
        network, sources = ARCHITECTURES[variant.network](NUM_OBJECTS), []
    else:
        network = _start(variant.network)
        sources = [load_dataset([trainings.data_path(variant.plans_only)])]
    network.to(device)
    config = replace(
        variant.learning,
        num_steps=trainings.num_steps,
        batch_size=variant.learning.batch_size // 2,
    )
    rounds = replace(variant.rounds, num_tasks=variant.rounds.num_tasks // 2)
    learner = FittedQ(network, sources, config, stream(training.seed, "reinforcement"))
    path = trainings.weights_path(training)
    reinforcement = Reinforcement(
        learner,
        rounds,
        path.with_suffix(".rounds"),
        training.seed,
        1,
        trainings.commit,
    )
    checkpoint = path.with_suffix(".checkpoint")
    curve_path = path.with_suffix(".curve.json")
    curve = json.loads(curve_path.read_text()) if curve_path.exists() else {}
    described = _describe(training)
    for event in train(learner, checkpoint, described, reinforcement):
        if isinstance(event, Stepped) and (
            event.num_steps % _PERIOD == 0 or event.num_steps == config.num_steps
        ):
            # Steps that are taken again after a stop have the same successes.
            curve[str(event.num_steps)], _ = greedy_successes(network)
            write_atomically(curve_path, json.dumps(curve))
    result = TrainingResult(
        training,
        tuple((int(step), successes) for step, successes in curve.items()),
        _rhp33_successes(network),
        _NUM_TASKS,
        reinforcement.num_transitions,
    )
    network.provenance = {
        "commit": trainings.commit,
        "seed": training.seed,
        "variant": described,
        "curve": result.curve,
        "rhp33": result.rhp33,
        "num_tasks": result.num_tasks,
        "num_transitions": result.num_transitions,
    }
    save_q_network(network, path)
    checkpoint.unlink(missing_ok=True)
    curve_path.unlink(missing_ok=True)
    reinforcement.forget()
    return result


def _rhp33_successes(network: QNetwork) -> int:
    push_model = PushModel(NUM_OBJECTS)
    policy = RecedingHorizon(push_model, deepcopy(network).cpu(), 3, 3, 0.5)
    instances = load_instances(VALIDATION)[:_NUM_TASKS]
    episodes = run_episodes(push_model.step, policy, instances)
    return sum(episode.succeeded for episode in episodes)
