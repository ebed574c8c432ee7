"""A scenario: everything that decides what happens in a run, in one YAML file.

A file maps names to scenarios.  What a scenario leaves out has the default that the
dataclasses here give it, so the shortest file is ``three_boxes: {}``.  Root keys
that begin with an underscore are skipped, a place for YAML anchors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from rhp_drake import task, typed_yaml
from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import SET_SIZE, SETS, load_instances
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.planning.policy_config import PolicyConfig, RecedingHorizonConfig
from rhp_drake.random_streams import TRAINING, VALIDATION, stream
from rhp_drake.resources import scenarios_path
from rhp_drake.station.station_models import StationConfig, resolve_directives
from rhp_drake.systems.command_guard import CommandGuardConfig
from rhp_drake.visualization import VisualizationConfig


@dataclass
class PlanarPose:
    """A pose on the table.

    Attributes:
        position: x and y, m in W.
        heading_deg: Angle about z, degrees.
    """

    position: np.ndarray = field(default_factory=lambda: np.zeros(2))
    heading_deg: float = 0.0


@dataclass
class Layout:
    """A task written out by hand; each obstacle has to stay where it starts.

    Attributes:
        hand: Pose of the hand H, whose x axis points out of its opening.
        target: Pose of the box that has to move.
        goal: Centre of the target's goal region, x and y, m in W.
        obstacles: Poses of the other boxes.
    """

    hand: PlanarPose = field(default_factory=PlanarPose)
    target: PlanarPose = field(default_factory=PlanarPose)
    goal: np.ndarray = field(default_factory=lambda: np.zeros(2))
    obstacles: list[PlanarPose] = field(default_factory=list)


@dataclass
class SampledInstance:
    """A task drawn at random, as section VII-A of the paper does.

    Attributes:
        set: "training", which has no end, or one of the sets of 500 tasks,
            "validation" and "evaluation".  They never share a task.
        index: Which task of the set; null for the scenario's seed.
    """

    set: str = VALIDATION
    index: int | None = None


@dataclass
class Scenario:
    """A scenario.

    Attributes:
        description: One sentence for people.
        seed: The seed of all that is random: the physics of the world, the policy's
            draws and, where its index is null, the task.  At least 0.
        task: The task instance.
        policy: Who decides.
        world_physics: How much the world's physics differ from the planner's model:
            a level of `rhp_drake.physics`.
        time_limit: When to give up, in simulated seconds.
        station: The robot, the table and the boxes.
        guard: Limits on what is commanded to the robot.
        visualization: What a run looks like in Meshcat.
    """

    description: str = ""
    seed: int = 0
    task: SampledInstance | Layout = field(default_factory=SampledInstance)
    policy: PolicyConfig = field(default_factory=RecedingHorizonConfig)
    world_physics: str = "none"
    time_limit: float = 600.0
    station: StationConfig = field(default_factory=StationConfig)
    guard: CommandGuardConfig = field(default_factory=CommandGuardConfig)
    visualization: VisualizationConfig = field(default_factory=VisualizationConfig)


def load_scenario(
    path: str | Path, name: str | None = None, overrides: Sequence[str] = ()
) -> tuple[str, Scenario]:
    """Loads and checks a scenario.

    Args:
        path: The file, or the bare name of one that comes with the package.
        name: Which of the file's scenarios; may be None if the file has one.
        overrides: YAML texts to merge into the scenario one after the other, e.g.
            "seed: 3".

    Returns:
        The scenario's name, and the scenario.

    Raises:
        InputError: If anything is wrong with it; the message names file and key.
    """
    where, name, node = read_named(Path(path), name, "scenario")
    scenario = typed_yaml.merge(node, Scenario(), where)
    for text in overrides:
        where_text = f"{where}, overridden by {text!r}"
        node = typed_yaml.read_document(text, where_text)
        scenario = typed_yaml.merge(node, scenario, where_text)
    resolve_directives(scenario.station, _find(Path(path)).resolve().parent)
    try:
        check_scenario(scenario)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return name, scenario


def read_named(
    path: Path, name: str | None, kind: str
) -> tuple[str, str, dict[str, Any]]:
    """Reads one of the named documents of a file.

    Args:
        path: The file, or the bare name of one that comes with the package.
        name: Of the document; may be None if the file has one.
        kind: What the documents are, for errors.

    Returns:
        What to call it in errors, its name, and the document.

    Raises:
        InputError: If there is no such document.
    """
    path = _find(path)
    document = typed_yaml.read_file(path)
    if name is None:
        # A file without names would look like one with many documents.
        _check_named(path, document, kind)
        if len(document) > 1:
            raise InputError(
                f"{path}: has several {kind}s where one has to be chosen: "
                f"{', '.join(document)}."
            )
        (name,) = document
    elif name not in document:
        raise InputError(f"{path}: has no {kind} {name!r}, only {', '.join(document)}.")
    _check_named(path, {name: document[name]}, kind)
    return f"{path}: {name}", name, document[name]


def _check_named(path: Path, document: dict[str, Any], kind: str) -> None:
    """Raises InputError unless the document maps names to documents."""
    for key, node in document.items():
        if not isinstance(node, dict):
            raise InputError(
                f"{path}: {key}: expected a {kind} with its name before it, "
                f"'some_name: {{{key}: ...}}', not {node!r}."
            )


def _find(path: Path) -> Path:
    """A bare name stands for a scenario that comes with the package."""
    if path.suffix or len(path.parts) > 1 or path.exists():
        return path
    return scenarios_path() / f"{path}.yaml"


def check_scenario(scenario: Scenario) -> None:
    """Raises InputError if a value of the right type is impossible all the same."""
    _check(scenario.seed >= 0, "seed", scenario.seed, "at least 0")
    good = 0 < scenario.time_limit < math.inf
    _check(good, "time_limit", scenario.time_limit, "positive and finite")
    scenario.station.validate()
    levels = ", ".join(UNCERTAINTY_LEVELS)
    known = scenario.world_physics in UNCERTAINTY_LEVELS
    _check(known, "world_physics", scenario.world_physics, f"one of {levels}")
    for key in ("camera", "camera_target"):
        point = getattr(scenario.visualization, key)
        good = point.shape == (3,) and np.isfinite(point).all()
        _check(good, f"visualization.{key}", point.tolist(), "three finite numbers")
    scenario.policy.validate()
    scenario.guard.validate()
    make_task_instance(scenario)


def make_task_instance(scenario: Scenario) -> task.TaskInstance:
    """The task instance <s_init, G> that the scenario names or writes out.

    Raises:
        InputError: If it is none; the message names the key.
    """
    num_objects = len(scenario.station.objects)
    config = scenario.task
    if isinstance(config, Layout):
        return _layout_instance(config, num_objects)
    sets = (TRAINING, *SETS)
    _check(config.set in sets, "task.set", config.set, f"one of {', '.join(sets)}")
    index = scenario.seed if config.index is None else config.index
    _check(index >= 0, "task.index", index, "at least 0")
    if config.set == TRAINING:
        return task.sample_instance(stream(0, TRAINING, index), num_objects)
    wanted = f"below {SET_SIZE}, the size of the {config.set} set"
    _check(index < SET_SIZE, "task.index (or seed)", index, wanted)
    return load_instances(config.set, num_objects)[index]


def _layout_instance(layout: Layout, num_objects: int) -> task.TaskInstance:
    """Checks a layout and turns it into a task instance."""
    _check(
        len(layout.obstacles) == num_objects - 1,
        "task.obstacles",
        f"a list of {len(layout.obstacles)}",
        f"one pose for each object of the station but the first, {num_objects - 1}",
    )
    bodies = {"task.hand": layout.hand, "task.target": layout.target} | {
        f"task.obstacles[{i}]": pose for i, pose in enumerate(layout.obstacles)
    }
    points = {f"{key}.position": pose.position for key, pose in bodies.items()}
    for key, point in (points | {"task.goal": layout.goal}).items():
        good = point.shape == (2,) and np.isfinite(point).all()
        _check(good, key, point.tolist(), "two finite numbers, x and y in metres")
    for key, pose in bodies.items():
        finite = math.isfinite(pose.heading_deg)
        _check(finite, f"{key}.heading_deg", pose.heading_deg, "finite")
    for key, point in points.items():
        if key == "task.hand.position":
            _check_inside(key, point, _WORKSPACE, "the hand's workspace")
        else:
            _check_inside(key, point, _TABLE, "the table")
    _check_inside("task.goal", layout.goal, _WORKSPACE, "the robot's reach")
    _check(
        abs(layout.hand.heading_deg) <= math.degrees(task.MAX_HEADING),
        "task.hand.heading_deg",
        layout.hand.heading_deg,
        f"within +-{math.degrees(task.MAX_HEADING):.0f}",
    )
    state = np.concatenate(
        [
            [*pose.position, math.radians(pose.heading_deg)]
            for pose in [layout.hand, layout.target, *layout.obstacles]
        ]
    )
    goals = task.object_positions(state).copy()
    goals[0] = layout.goal
    if overlaps := task.overlapping_bodies(state):
        raise InputError(
            f"task: bodies overlap: {', '.join(overlaps)} (object 0 is the target)."
        )
    if task.goals_reached(state, goals):
        raise InputError("task.goal: the target is in its goal region at the start.")
    return task.TaskInstance(state, goals)


_WORKSPACE: Final = (task.WORKSPACE_LOWER, task.WORKSPACE_UPPER)
_TABLE: Final = (task.TABLE_LOWER, task.TABLE_UPPER)


def _check(good: bool, key: str, value: Any, wanted: str) -> None:
    """Raises InputError unless `good`."""
    if not good:
        raise InputError(f"{key}: must be {wanted}, not {value}.")


def _check_inside(
    key: str, point: np.ndarray, box: tuple[np.ndarray, np.ndarray], name: str
) -> None:
    """Raises InputError unless `point` is inside `box`."""
    lower, upper = box
    if (point < lower).any() or (point > upper).any():
        raise InputError(
            f"{key}: {point.tolist()} is out of {name}, x {lower[0]:g} to "
            f"{upper[0]:g} and y {lower[1]:g} to {upper[1]:g} m."
        )
