"""A folder of results: files of episodes, and what they have in common.

``pandas.read_parquet(folder / "episodes")`` reads all of them; `episode_files` explains
the columns.

`settings.json` beside it says what all rows have in common (instances, number of
objects, world, seed) and what each column's policy is.  A batch of episodes is a file;
work that is stopped goes on with the batches that are not there.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
import hashlib
import json
from pathlib import Path
from typing import Any, Final

from rhp_drake.errors import InputError
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.episode_files import (
    num_episodes,
    read_episodes,
    write_episodes,
)
from rhp_drake.evaluation.experiment import (
    Batch,
    Column,
    Experiment,
    Trial,
    run_batches,
)
from rhp_drake.evaluation.paper_results import SHIPPED_WEIGHTS
from rhp_drake.files import exclusive, write_atomically
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.planning.policy_config import POLICIES, PolicyConfig
from rhp_drake.resources import resolve
from rhp_drake.workers import Workers

_FORMAT: Final = "rhp_drake results 1"
_SETTINGS: Final = "settings.json"
_EPISODES: Final = "episodes"
# The setting that says what each column's policy is.
_COLUMNS: Final = "columns"


@dataclass(frozen=True)
class Results:
    """What a folder holds.

    Attributes:
        settings: What all episodes have in common.
        episodes: By policy, as the paper's table, level, trial and instance.
        commits: Of the code that made them.
        machines: That made them.
    """

    settings: dict[str, Any]
    episodes: list[tuple[Trial, Episode]]
    commits: list[str]
    machines: list[str]


def run_experiment(
    folder: Path,
    experiment: Experiment,
    workers: Workers,
    commit: str = "unknown",
    machine: str = "unknown",
) -> Iterator[int]:
    """Runs the batches that a folder lacks, and writes each as it is done.

    Args:
        folder: Made if need be; it may hold other columns, levels, instances and
            trials of the same experiment.
        experiment: What to run.
        workers: Who runs it; this changes times alone.
        commit: Of the code, to be noted.
        machine: To be noted.

    Yields:
        How many of the experiment's episodes are there, at first and after each batch.

    Raises:
        InputError: If the folder is of another experiment or none, is damaged, or
            another process works there.
        WorkError: If a worker dies or a file cannot be written; nothing is lost.
    """
    _check_ours(folder)
    with exclusive(folder):
        settings = _merged_settings(folder, experiment)
        write_atomically(folder / _SETTINGS, json.dumps(settings, indent=1) + "\n")
        missing = []
        done = 0
        for batch in experiment.batches():
            there = num_episodes(_path(folder, batch))
            if there < len(batch.indices):
                missing.append(batch)
            else:
                done += len(batch.indices)
        yield done
        about = {"commit": commit, "machine": machine}
        for batch, episodes in run_batches(experiment, missing, workers):
            write_episodes(_path(folder, batch), batch.trials(), episodes, about)
            done += len(episodes)
            yield done


def read_results(folder: Path) -> Results:
    """Reads all episodes of a folder.

    Raises:
        InputError: If it holds no results, or a file is damaged or does not belong
            there; the message names it.
    """
    settings = _read_settings(folder)
    columns = [Column(c["policy"], c["weights"]) for c in settings[_COLUMNS]]
    order = {column: k for k, column in enumerate(sorted(columns, key=_rank))}
    levels = list(settings["levels"])
    episodes: list[tuple[Trial, Episode]] = []
    abouts: list[dict[str, str]] = []
    seen: set[Trial] = set()
    for path in sorted((folder / _EPISODES).glob("*.parquet")):
        of_file, about = read_episodes(path)
        for trial, episode in of_file:
            if trial.column not in order or trial.level not in levels:
                raise InputError(
                    f"{path}: holds episodes of {trial.column} ({trial.level}), which "
                    f"{_SETTINGS} does not know."
                )
            if trial in seen:
                raise InputError(f"{path}: holds episodes that another file has, too.")
            seen.add(trial)
            episodes.append((trial, episode))
        abouts.append(about)
    if not episodes:
        raise InputError(f"{folder}: holds no episodes yet.")
    episodes.sort(
        key=lambda row: (
            order[row[0].column],
            levels.index(row[0].level),
            row[0].number,
            row[0].index,
        )
    )
    commits, machines = (
        list(dict.fromkeys(about[key] for about in abouts))
        for key in ("commit", "machine")
    )
    return Results(settings, episodes, commits, machines)


def _rank(column: Column) -> tuple[int, int]:
    """By which columns are sorted: as the paper's table, whatever was run first.

    First those without a Q-network, then each Q-network's, those that come with the
    package first.  Names that are not known keep their order.
    """
    weights, policies = ("", *SHIPPED_WEIGHTS), tuple(POLICIES)
    return (
        weights.index(column.weights) if column.weights in weights else len(weights),
        policies.index(column.policy) if column.policy in policies else len(policies),
    )


def _path(folder: Path, batch: Batch) -> Path:
    """Of a batch, by its first instance: more instances of a set go on from there."""
    column = _file_name(batch.column.policy, batch.column.weights)
    name = f"{column}_{batch.level}_{batch.number:02d}_{batch.indices.start:03d}"
    return folder / _EPISODES / f"{name}.parquet"


def _file_name(policy: str, weights: str) -> str:
    """What the names of a column's files begin with."""
    return f"{policy}_{weights}" if weights else policy


def _check_ours(folder: Path) -> None:
    """Raises InputError if there is a folder with something else in it."""
    if not folder.exists() or (folder / _SETTINGS).exists():
        return
    if not folder.is_dir() or any(not p.name.startswith("_") for p in folder.iterdir()):
        raise InputError(
            f"{folder}: is no folder of results (there is no {_SETTINGS}), nor empty; "
            "choose another one."
        )


def _merged_settings(folder: Path, experiment: Experiment) -> dict[str, Any]:
    """The settings of folder and experiment.

    Raises:
        InputError: If they do not agree.
    """
    ours: dict[str, Any] = {
        "format": _FORMAT,
        "world": experiment.world,
        "instances": experiment.instances,
        "num_objects": experiment.num_objects,
        "seed": experiment.seed,
        "levels": list(experiment.levels),
        _COLUMNS: [_describe(*item) for item in experiment.columns.items()],
    }
    if not (folder / _SETTINGS).exists():
        return ours
    noted = _read_settings(folder)
    for name in ("world", "instances", "num_objects", "seed"):
        if noted[name] != ours[name]:
            raise InputError(
                f"{folder}: holds results of {name} {noted[name]!r}, not "
                f"{ours[name]!r}; choose another folder."
            )
    columns = {(c["policy"], c["weights"]): c for c in noted[_COLUMNS]}
    for column in ours[_COLUMNS]:
        key = column["policy"], column["weights"]
        there = columns.setdefault(key, column)
        if there != column:
            differences = ", ".join(
                f"{name} {there.get(name)!r}, not {column.get(name)!r}"
                for name in {**there, **column}
                if there.get(name) != column.get(name)
            )
            raise InputError(
                f"{folder}: holds results of another policy {' '.join(key).strip()!r} "
                f"({differences}); choose another folder."
            )
    # gp_rescue with weights x, and gp with weights rescue_x.
    names = Counter(_file_name(*key) for key in columns)
    if clashing := [name for name, count in names.items() if count > 1]:
        raise InputError(
            f"{folder}: two policies would have files of the name {clashing[0]!r}; "
            "rename the weights, or choose another folder."
        )
    known = {*noted["levels"], *ours["levels"]}
    levels = [level for level in UNCERTAINTY_LEVELS if level in known]
    return ours | {"levels": levels, _COLUMNS: list(columns.values())}


def _describe(column: Column, config: PolicyConfig) -> dict[str, Any]:
    """All that a column's episodes depend on; of its weights the file's checksum."""
    values = dict(vars(config))
    uri = values.pop("q_network", None)
    if uri is not None:
        values["q_network_sha256"] = _checksum(resolve(uri))
    return {"policy": column.policy, "weights": column.weights, **values}


def _checksum(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}.") from None


def _read_settings(folder: Path) -> dict[str, Any]:
    path = folder / _SETTINGS
    try:
        settings = dict(json.loads(path.read_text()))
        if settings["format"] != _FORMAT:
            raise InputError(
                f"{path}: has the format {settings['format']!r}, not {_FORMAT!r}."
            )
        wanted = {"world", "instances", "num_objects", "seed", "levels", _COLUMNS}
        if lacking := wanted - set(settings):
            raise InputError(f"{path}: lacks {min(lacking)!r}.")
        for column in settings[_COLUMNS]:
            if lacking := {"policy", "weights"} - set(column):
                raise InputError(f"{path}: a column lacks {min(lacking)!r}.")
    except FileNotFoundError:
        raise InputError(
            f"{folder}: is no folder of results: there is no {_SETTINGS}."
        ) from None
    except (OSError, ValueError, TypeError, KeyError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not readable settings ({error}).") from error
    return settings
