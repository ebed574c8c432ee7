"""Scenario files: what they may say, what is wrong with them, and overrides."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from rhp_drake import cli, typed_yaml
from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import SETS, load_instances
from rhp_drake.planning.policy_config import (
    GreedyConfig,
    MakePolicy,
    OpenLoopConfig,
    RecedingHorizonConfig,
)
from rhp_drake.resources import scenarios_path
from rhp_drake.scenario import (
    Layout,
    PlanarPose,
    SampledInstance,
    Scenario,
    load_scenario,
    make_task_instance,
)
from rhp_drake.task import goals_reached, overlapping_bodies

LAYOUT = """
hand: {position: [0.30, 0.0]}
target: {position: [0.50, 0.0], heading_deg: 90}
goal: [0.70, 0.0]
obstacles: [{position: [0.50, 0.2]}, {position: [0.50, -0.2]}]
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "test.yaml"
    path.write_text(text)
    return path


def layout(old: str = "", new: str = "") -> str:
    """A file with `LAYOUT`, after a replacement."""
    assert old in LAYOUT
    lines = LAYOUT.replace(old, new).strip().splitlines()
    return "\n    ".join(["a:\n  task: !Layout", *lines])


def error_of(path: Path, *args) -> str:
    with pytest.raises(InputError) as info:
        load_scenario(path, *args)
    message = str(info.value)
    assert message.startswith(str(path))
    assert message.endswith(".")
    assert "\n" not in message
    return message.removeprefix(str(path))


# What `--hardware` takes is there, too.
LABS = {"hardware", "lcm", "virtual_lab"}
BUNDLED = sorted(x for x in scenarios_path().glob("*.yaml") if x.stem not in LABS)


@pytest.mark.parametrize("path", BUNDLED, ids=str)
def test_bundled(path):
    name, scenario = load_scenario(path)
    assert name == path.stem
    instance = make_task_instance(scenario)
    assert instance.num_objects == len(scenario.station.objects)
    assert not overlapping_bodies(instance.initial_state)
    assert not goals_reached(instance.initial_state, instance.goals)
    assert load_scenario(path.stem)[0] == name
    # Its weights are for so many objects.
    MakePolicy(scenario.policy, instance.num_objects)


def test_layout(tmp_path):
    _, scenario = load_scenario(write(tmp_path, layout()))
    instance = make_task_instance(scenario)
    expected = [0.3, 0, 0, 0.5, 0, np.pi / 2, 0.5, 0.2, 0, 0.5, -0.2, 0]
    np.testing.assert_allclose(instance.initial_state, expected)
    np.testing.assert_allclose(instance.goals, [[0.7, 0], [0.5, 0.2], [0.5, -0.2]])


def test_seed_chooses_task_unless_index_does(tmp_path):
    path = write(tmp_path, "free: {}\nfixed: {task: {index: 4}}")

    def state(name: str, seed: int) -> np.ndarray:
        _, scenario = load_scenario(path, name, [f"seed: {seed}"])
        return make_task_instance(scenario).initial_state

    assert (state("free", 4) == state("fixed", 1)).all()
    assert (state("fixed", 1) == state("fixed", 2)).all()
    assert (state("free", 1) != state("free", 2)).any()


def test_indices_are_those_of_the_frozen_sets():
    for name in SETS:
        frozen = load_instances(name)[7]
        instance = make_task_instance(Scenario(task=SampledInstance(name, 7)))
        assert (instance.initial_state == frozen.initial_state).all()
        assert (instance.goals == frozen.goals).all()


def test_overrides_in_order(tmp_path):
    path = write(tmp_path, "a: {seed: 1, policy: !GreedyConfig {q_network: w}}")
    _, scenario = load_scenario(path, overrides=["seed: 2", "world_physics: low"])
    assert scenario.seed == 2
    assert scenario.policy == GreedyConfig(q_network="w")
    overrides = ["policy: !RecedingHorizonConfig {horizon: 3}", "policy: {horizon: 2}"]
    _, scenario = load_scenario(path, overrides=overrides)
    assert scenario.policy == RecedingHorizonConfig(horizon=2)


def test_override_without_a_tag_keeps_the_kind(tmp_path):
    path = write(tmp_path, "a: {policy: !GreedyConfig {rescue: true}}")
    _, scenario = load_scenario(path, overrides=["policy: {q_network: w}"])
    assert scenario.policy == GreedyConfig(q_network="w", rescue=True)
    path = write(tmp_path, layout())
    _, scenario = load_scenario(path, overrides=["task: {goal: [0.7, 0.1]}"])
    assert isinstance(scenario.task, Layout)
    np.testing.assert_array_equal(scenario.task.goal, [0.7, 0.1])
    np.testing.assert_array_equal(scenario.task.target.position, [0.5, 0.0])
    # A tag chooses another kind, with its defaults.
    _, scenario = load_scenario(path, overrides=["task: !SampledInstance {}"])
    assert scenario.task == SampledInstance()


def test_override_of_a_key_that_the_kind_does_not_have():
    for text, message in (
        (
            "policy: {num_roll_outs: 3}",
            "policy.num_roll_outs: there is no such key in !OpenLoopConfig.",
        ),
        # Known, but elsewhere.
        ("task: {seed: 3}", "task.seed: there is no such key in !Layout."),
    ):
        overridden = typed_yaml.read_document(text, "text")
        defaults = Scenario(policy=OpenLoopConfig(), task=Layout())
        with pytest.raises(InputError) as info:
            typed_yaml.merge(overridden, defaults, "text")
        assert str(info.value) == f"text: {message}"


def test_kinds_of_nested_parts_are_kept():
    @dataclass
    class Inner:
        task: SampledInstance | Layout = field(default_factory=SampledInstance)
        port: PlanarPose | None = field(default_factory=PlanarPose)

    @dataclass
    class Outer:
        inner: Inner = field(default_factory=Inner)

    defaults = Outer(Inner(Layout(goal=np.ones(2)), PlanarPose(heading_deg=3.0)))
    node = {"inner": {"task": {"hand": {"heading_deg": 5}}, "port": {"position": [1]}}}
    merged = typed_yaml.merge(node, defaults, "text").inner
    assert isinstance(merged.task, Layout)
    assert merged.task.goal.tolist() == [1, 1]
    assert merged.task.hand.heading_deg == 5
    assert merged.port.heading_deg == 3


def test_defaults_are_not_shared():
    first, second = Scenario(), Scenario()
    first.station.objects.append("another")
    assert len(second.station.objects) == 3


def test_expanded_scenario_loads_again(tmp_path):
    _, scenario = load_scenario(write(tmp_path, layout()), overrides=["seed: 7"])
    again = typed_yaml.merge(typed_yaml.expand(scenario), Scenario(), "again")
    assert typed_yaml.expand(again) == typed_yaml.expand(scenario)
    assert isinstance(again.task, Layout)
    assert again.seed == 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: {polcy: {}}", ": a: polcy: there is no such key; perhaps 'policy' is"),
        ("a: {station: {plant: {tim_step: 1}}}", ": a: station.plant.tim_step: there"),
        (
            "a: {policy: {horizn: 3}}",
            ": a: policy.horizn: there is no such key in !RecedingHorizonConfig; "
            "perhaps 'horizon' is meant.",
        ),
        (
            "a: {station: {directives: [{}, {add_modl: {}}]}}",
            ": a: station.directives[1].add_modl: there is no such key.",
        ),
        (
            "a: {policy: !RHP {horizon: 3}}",
            ": a: policy: !RHP is none of !RecedingHorizonConfig, !GreedyConfig, !Op",
        ),
        ("a: {policy: GreedyConfig}", ": a: policy: expected a mapping, '!Tag {key: "),
        ("a:\n  policy: !GreedyConfig", ", line 2: not valid YAML: expected a mapping"),
        ("a: {policy: {num_roll_outs: -1}}", ": a: policy.num_roll_outs is -1; it m"),
        ("a: {policy: {horizon: 0}}", ": a: policy.horizon is 0; it must be at least"),
        ("a: {policy: {temperature: 0}}", ": a: policy.temperature is 0.0; it must b"),
        ("a: {policy: {horizon: 2.5}}", ": a: policy.horizon: expected an integer, n"),
        ("a: {policy: {horizon: x}}", ": a: policy.horizon: 'x' is not a value it ca"),
        ("a: {seed: -1}", ": a: seed: must be at least 0, not -1."),
        ("a: {station: {plant: {time_step: 0}}}", ": a: station.plant.time_step: must"),
        ("a: {station: {plant: {time_step: 0.1}}}", ": a: station.plant.time_step: mu"),
        ("a: {station: {objects: []}}", ": a: station.objects: must be names of diff"),
        ("a: {station: {objects: [b, b]}}", ": a: station.objects: must be names of "),
        (
            "a: {station: {position_gains: [1, 2]}}",
            ": a: station.position_gains: must be 6 finite numbers, none of them neg",
        ),
        (
            "a: {station: {velocity_gains: [1, 2, 3, 4, 5, -1]}}",
            ": a: station.velocity_gains: must be 6 finite numbers, none of them neg",
        ),
        (
            "a: {time_limit: 0}",
            ": a: time_limit: must be positive and finite, not 0.0.",
        ),
        ("a: {world_physics: extreme}", ": a: world_physics: must be one of none, lo"),
        ("a: {task: {set: test}}", ": a: task.set: must be one of training, validat"),
        ("a: {task: {index: -1}}", ": a: task.index: must be at least 0, not -1."),
        ("a: {seed: 500}", ": a: task.index (or seed): must be below 500, the size of"),
        ("a: {visualization: {camera: [1]}}", ": a: visualization.camera: must be t"),
        ("a: [", ", line 1: not valid YAML: "),
        ("", ": expected a mapping of names to values."),
        ("- a", ": expected a mapping of names to values."),
        ("seed: 3", ": seed: expected a scenario with its name before it, "),
        ("a: {}\nb: {}", ": has several scenarios where one has to be chosen: a, b."),
    ],
)
def test_bad_file(tmp_path, text, message):
    assert error_of(write(tmp_path, text)).startswith(message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0.70, 0.0]", "[1.70, 0.0]", "task.goal: [1.7, 0.0] is out of the robot's r"),
        ("[0.70, 0.0]", "[0.52, 0.0]", "task.goal: the target is in its goal region a"),
        ("[0.70, 0.0]", "[0.70]", "task.goal: must be two finite numbers"),
        ("[0.70, 0.0]", "[.nan, 0]", "task.goal: must be two finite numbers"),
        ("[0.30, 0.0]", "[0.10, 0.0]", "task.hand.position: [0.1, 0.0] is out of the"),
        ("[0.30, 0.0]", "[0.54, 0.0]", "task: bodies overlap: hand and object 0 "),
        ("[0.50, 0.2]", "[0.50, 0.05]", "task: bodies overlap: object 0 and object 1"),
        ("[0.50, 0.2]", "[0.50, 0.5]", "task.obstacles[0].position: [0.5, 0.5] is ou"),
        ("{position: [0.50, 0.2]}, ", "", "task.obstacles: must be one pose for each"),
        ("deg: 90", "deg: .inf", "task.target.heading_deg: must be finite, not inf."),
        ("goal:", "gaol:", "task.gaol: there is no such key"),
    ],
)
def test_bad_layout(tmp_path, old, new, message):
    error = error_of(write(tmp_path, layout(old, new)))
    assert error.startswith(f": a: {message}")


def test_bad_names_and_overrides(tmp_path):
    path = write(tmp_path, "a: {}")
    assert error_of(path, "b") == ": has no scenario 'b', only a."
    assert error_of(path, None, ["sed: 1"]).startswith(": a, overridden by 'sed: 1': s")
    assert (
        error_of(path, None, ["seed: -1"]) == ": a: seed: must be at least 0, not -1."
    )
    missing = tmp_path / "missing.yaml"
    assert error_of(missing) == ": cannot be read: no such file or directory."
    assert error_of(tmp_path) == ": cannot be read: is a directory."


@pytest.mark.parametrize(
    "arguments",
    [
        ["missing.yaml"],
        ["three_boxes", "--seed", "-1"],
        ["three_boxes", "--policy", "unknown"],
        ["three_boxes", "--name", "unknown"],
        ["three_boxes", "--scenario-text", "sed: 1"],
        ["three_boxes", "--scenario-text", "policy: {q_network: missing}"],
        ["three_boxes", "--scenario-text", "station: {objects: [unknown]}"],
        ["three_boxes", "--scenario-text", "station: {plant: {time_step: -1}}"],
        ["three_boxes", "--scenario-text", "station: {position_gains: [-1, 1]}"],
        ["three_boxes", "--scenario-text", "station: {plant: {contact_model: none}}"],
        ["three_boxes", "--policy", "kdp", "--out", "/dev/null/folder"],
    ],
    ids=" ".join,
)
def test_command_line_reports_bad_input(arguments, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["rhp", "run", "--no-meshcat", *arguments])
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert info.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("rhp: ")
    assert not list(tmp_path.iterdir())
