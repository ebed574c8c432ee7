"""Figure 4 of the paper: the greedy policy's success, by how many plans it imitated.

A point of the figure is one training, of the first P plans under one seed, as `rhp
imitate` does it, and its evaluation on a frozen set of instances.  As in section VII-B
the 500 instances make 25 batches of 20.

A folder holds `settings.json`, what all its points have in common; `plans.parquet`, the
plans that come with the package, with their states; and `points`, the weights of each
point.  Their provenance says which instances they solve, so that a point is done once
its file is there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
import json
from pathlib import Path
from typing import Any, Final

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import greedy_episodes
from rhp_drake.evaluation.figure4_data import Point, PointResult, batch_successes
from rhp_drake.files import exclusive, write_atomically
from rhp_drake.frozen_instances import NUM_OBJECTS, load_instances
from rhp_drake.learning.dataset import first_plans, load_dataset
from rhp_drake.learning.demonstration_files import read_table
from rhp_drake.learning.demonstration_folder import describe
from rhp_drake.learning.imitation import Imitation, ImitationConfig
from rhp_drake.learning.replay import SHIPPED_PLANS, rebuild
from rhp_drake.learning.training import make_repeatable, train
from rhp_drake.random_streams import stream
from rhp_drake.value.q_network import PaperQNetwork
from rhp_drake.value.weights import load_q_network, save_q_network
from rhp_drake.workers import run_over

_SETTINGS: Final = "settings.json"
_PLANS: Final = "plans.parquet"


@dataclass(frozen=True, kw_only=True)
class Figure4:
    """What the points of one folder have in common.

    Attributes:
        folder: Where the work is kept.
        demonstrations: Files and folders of plans; none for those of the package.
        config: Of all trainings.
        instances: Name of the set of instances.
        commit: Of the code, to be noted.
    """

    folder: Path
    demonstrations: tuple[Path, ...]
    config: ImitationConfig
    instances: str
    commit: str = "unknown"

    def make_points(
        self, points: Sequence[Point], num_workers: int
    ) -> Iterator[PointResult]:
        """Trains and evaluates those points that the folder lacks.

        Killed at any moment, it goes on from the points' last checkpoints, with the
        same results.

        Returns:
            An iterator, which does the work: the points that were there, and then each
            as it is done.

        Raises:
            InputError: If there are fewer plans than a point asks for, no such set of
                instances, or the folder is of other settings.
            WorkError: If a worker dies or a file cannot be written.
        """
        load_instances(self.instances)
        self._check_plans(max(point.num_plans for point in points))
        self._check_settings()
        # Elsewhere, so that bad input is reported before anyone asks for a point.
        return self._make(points, num_workers)

    def _make(self, points: Sequence[Point], num_workers: int) -> Iterator[PointResult]:
        with exclusive(self.folder):
            settings = json.dumps(self.settings(), indent=1)
            write_atomically(self.folder / _SETTINGS, settings + "\n")
            if not self.demonstrations:
                if not (self.folder / _PLANS).exists():
                    rebuild(SHIPPED_PLANS, self.folder / _PLANS)
                # Some may not have reached their goals again.
                self._check_plans(max(point.num_plans for point in points))
            missing = []
            for point in points:
                if self.weights_path(point).exists():
                    yield self._read(point)
                else:
                    missing.append(point)
            work = partial(_make_point, figure=self)
            for _, result in run_over(work, missing, num_workers):
                yield result

    def weights_path(self, point: Point) -> Path:
        """Where the weights of a point are once it is done."""
        name = f"plans_{point.num_plans:05d}_seed_{point.seed}.safetensors"
        return self.folder / "points" / name

    def plan_paths(self) -> tuple[Path, ...]:
        """Of the plans with their states."""
        return self.demonstrations or (self.folder / _PLANS,)

    def settings(self) -> dict[str, Any]:
        """What the points depend on, beside numbers of plans and seeds."""
        sources = self.demonstrations or (SHIPPED_PLANS,)
        return {
            **asdict(self.config),
            "instances": self.instances,
            "demonstrations": [describe(path) for path in sources],
        }

    def _check_plans(self, num_plans: int) -> None:
        if self.demonstrations:
            data = load_dataset(self.demonstrations)
            available = int(data.solved.sum())
            if data.goals.shape[1] != NUM_OBJECTS:
                raise InputError(
                    f"the demonstrations are of {data.goals.shape[1]} objects, the "
                    f"tasks to evaluate on of {NUM_OBJECTS}."
                )
        else:
            rebuilt = self.folder / _PLANS
            plans = rebuilt if rebuilt.exists() else SHIPPED_PLANS
            available = read_table(plans, ["task"]).num_rows
        if num_plans > available:
            raise InputError(
                f"{num_plans} plans were asked for; there are {available}."
            )

    def _check_settings(self) -> None:
        """Compares the settings with those of the points that are there."""
        path = self.folder / _SETTINGS
        if not path.exists():
            return
        settings = self.settings()
        try:
            noted = dict(json.loads(path.read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise InputError(f"{path}: not readable settings ({error}).") from error
        names = [name for name in settings if noted.get(name) != settings[name]]
        if names:
            raise InputError(
                f"{self.folder} was made with other settings ({', '.join(names)}); "
                "choose another folder."
            )

    def _read(self, point: Point) -> PointResult:
        """A point that is done."""
        path = self.weights_path(point)
        provenance = load_q_network(path, NUM_OBJECTS).provenance
        return PointResult(
            point, tuple(provenance["successes"]), provenance["batch_size"]
        )


def _make_point(point: Point, figure: Figure4) -> PointResult:
    """Trains, evaluates, and writes the weights."""
    learner = _train(point, figure)
    instances = load_instances(figure.instances)
    episodes = greedy_episodes(learner.network, instances)
    successes = batch_successes([episode.succeeded for episode in episodes])
    result = PointResult(point, successes, len(instances) // len(successes))
    learner.network.provenance = {
        "commit": figure.commit,
        **figure.settings(),
        **asdict(point),
        "loss": learner.mean_loss,
        "successes": successes,
        "batch_size": result.batch_size,
    }
    save_q_network(learner.network, figure.weights_path(point))
    _checkpoint_path(point, figure).unlink(missing_ok=True)
    return result


def _checkpoint_path(point: Point, figure: Figure4) -> Path:
    weights = figure.weights_path(point)
    return weights.with_name(weights.name + ".checkpoint")


def _train(point: Point, figure: Figure4) -> Imitation:
    """Trains to the end, from a checkpoint if there is one."""
    device = make_repeatable(point.seed)
    data = first_plans(load_dataset(figure.plan_paths()), point.num_plans)
    network = PaperQNetwork(NUM_OBJECTS).to(device)
    generator = stream(point.seed, "imitation")
    learner = Imitation(network, data, figure.config, generator)
    checkpoint = _checkpoint_path(point, figure)
    origin = figure.settings() | asdict(point)
    for _ in train(learner, checkpoint, origin):
        pass
    return learner
