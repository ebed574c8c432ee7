from dataclasses import replace
import json

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput
import pytest

from rhp_drake import cli, task
from rhp_drake.closed_loop import AddClosedLoop, MakeClosedLoop
from rhp_drake.physics import draw_physics, nominal_physics
from rhp_drake.planning.policy import Decision
from rhp_drake.planning.policy_config import named_policy
from rhp_drake.random_streams import stream
from rhp_drake.run_closed_loop import output_of, run_closed_loop
from rhp_drake.scenario import Scenario, load_scenario, make_task_instance
from rhp_drake.systems.receding_horizon_planner import Status

POLICY = "rhp_drake.planning.policy_config.MakePolicy"


class RandomPolicy:
    """Quick, and looks at all that a policy is given: any change shows."""

    def decide(self, state, goals, generator, memory=None):
        action = int(generator.choice(np.flatnonzero(task.allowed_actions(state))))
        after = state.copy()
        after[:3] = task.hand_targets(state, action)
        value = float(state @ np.arange(len(state)) + goals.sum())
        roll_outs = np.array([[state, after]])
        return Decision(action, value, roll_outs, np.array([value]))


class Forward:
    """Pushes on."""

    def decide(self, state, goals, generator, memory=None):
        return Decision(int(task.Action.FORWARD), np.nan)


@pytest.fixture(scope="module")
def simulator():
    return Simulator(MakeClosedLoop(Scenario(), RandomPolicy()))


def run(simulator, *, index=0, seed=0, level="none", time_limit=3.0):
    instance = task.sample_instance(stream(index, "test_closed_loop"))
    physics = draw_physics(level, instance.initial_state, stream(seed, "physics"))
    records = []
    outcome = run_closed_loop(
        simulator,
        instance,
        physics,
        seed=seed,
        time_limit=time_limit,
        on_decision=records.append,
    )
    return outcome, [
        (r.index, r.time, r.decision.action, r.decision.value, *r.state)
        for r in records
    ]


def test_nothing_remains_of_the_run_before(simulator):
    first = run(simulator, index=1, seed=5, level="high")
    others = [
        run(simulator, index=2, seed=5),
        run(simulator, index=1, seed=6, level="high"),
        run(simulator, index=1, seed=5),
    ]
    assert run(simulator, index=1, seed=5, level="high") == first
    fresh = Simulator(MakeClosedLoop(Scenario(), RandomPolicy()))
    assert run(fresh, index=1, seed=5, level="high") == first
    assert first not in others
    outcome, decisions = first
    assert outcome.status == "time_limit"
    assert outcome.num_actions == len(decisions) >= 2
    assert [d[0] for d in decisions] == list(range(len(decisions)))


def test_pushes_target_home():
    scenario = Scenario()
    state = np.array([0.35, 0, 0, 0.42, 0, 0, 0.3, 0.2, 0, 0.3, -0.2, 0])
    goals = np.array([[0.6, 0.0], [0.3, 0.2], [0.3, -0.2]])
    simulator = Simulator(MakeClosedLoop(scenario, Forward()))
    instance = task.TaskInstance(state, goals)
    outcome = run_closed_loop(simulator, instance, nominal_physics(3), seed=0)
    assert outcome.succeeded
    assert 2 <= outcome.num_actions <= 5
    assert outcome.target_distance <= task.GOAL_RADIUS
    final = output_of(simulator, "state_estimator", "state")
    assert task.goals_reached(final, goals)
    # The far border of the workspace stops a hand that finds nothing to push.
    far = task.TaskInstance(np.r_[0.75, 0.29, state[2:]], goals)
    outcome = run_closed_loop(simulator, far, nominal_physics(3), seed=0)
    assert outcome.status == "policy_failed"
    assert "FORWARD" in outcome.message


def test_the_loop_is_part_of_another_diagram():
    """What README shows: the loop in one's own builder, with a logger."""
    builder = DiagramBuilder()
    AddClosedLoop(builder, Scenario(), RandomPolicy())
    guard = builder.GetSubsystemByName("command_guard")
    logger = LogVectorOutput(guard.GetOutputPort("position"), builder)
    simulator = Simulator(builder.Build())
    outcome, decisions = run(simulator, index=1, seed=5)
    alone = Simulator(MakeClosedLoop(Scenario(), RandomPolicy()))
    assert run(alone, index=1, seed=5) == (outcome, decisions)
    log = logger.FindLog(simulator.get_context())
    assert log.data().shape[0] == 6
    assert np.ptp(log.data(), axis=1).max() > 0.01


def test_a_loop_without_a_task_stands_still():
    simulator = Simulator(MakeClosedLoop(Scenario(), Forward()))
    simulator.AdvanceTo(0.5)
    assert output_of(simulator, "planner", "status")[0] == Status.POLICY_FAILED
    assert "are not finite" in output_of(simulator, "planner", "message")
    assert output_of(simulator, "planner", "decision").index == -1


def test_guard_fault_ends_run():
    scenario = Scenario()
    scenario.guard = replace(scenario.guard, velocity_limit=1e-3)
    outcome, decisions = run(Simulator(MakeClosedLoop(scenario, RandomPolicy())))
    assert outcome.status == "guard_fault"
    assert (
        "a command is too far from the one before (velocity_limit)." in outcome.message
    )
    assert len(decisions) == 1


@pytest.fixture
def rhp(monkeypatch, tmp_path):
    """Runs `rhp run` with a random policy, returns exit status and results."""
    monkeypatch.setattr(POLICY, lambda *args, **kwargs: RandomPolicy())

    def run_rhp(out, *arguments):
        options = ["--no-realtime", "--out", str(tmp_path / out)]
        monkeypatch.setattr("sys.argv", ["rhp", "run", *arguments, *options])
        with pytest.raises(SystemExit) as info:
            cli.main()
        return info.value.code, json.loads((tmp_path / out / "run.json").read_text())

    return run_rhp


@pytest.mark.parametrize("name", ["gp", "rhp33", "rhp66_rescue"])
def test_another_policy_keeps_the_weights(name, rhp, tmp_path):
    paper = "package://rhp_drake/q_network/paper.safetensors"
    file = tmp_path / "mine.yaml"
    file.write_text(f"mine: {{time_limit: 0.1, policy: {{q_network: {paper}}}}}\n")
    _, record = rhp("out", str(file), "--policy", name, "--no-meshcat")
    policy = record["scenario"]["policy"]
    assert policy["q_network"] == paper
    tag = policy.get("_tag", "!RecedingHorizonConfig")
    assert tag == f"!{type(named_policy(name)).__name__}"


def without_times(record: dict) -> dict:
    decisions = [
        {key: value for key, value in entry.items() if key != "milliseconds"}
        for entry in record["decisions"]
    ]
    return {**record, "times": None, "decisions": decisions}


def test_run_json_and_recording(rhp, tmp_path, capsys):
    short = ("three_boxes", "--seed", "8", "--scenario-text", "{time_limit: 2.5}")
    short += ("--policy", "rhp33")
    code, record = rhp("first", *short)
    assert code == 1
    printed = capsys.readouterr()
    assert "Meshcat: http://localhost:" in printed.out
    assert "Time limit: not done after 2.5 s in the world." in printed.out
    assert printed.err == ""
    assert "<html>" in (tmp_path / "first" / "recording.html").read_text()
    assert sorted(path.name for path in (tmp_path / "first").iterdir()) == [
        "recording.html",
        "run.json",
    ]
    assert record["seed"] == 8
    assert record["scenario"]["time_limit"] == 2.5
    assert record["scenario"]["policy"]["horizon"] == 3
    assert record["versions"]["drake"]
    assert record["hardware"] is None
    instance = make_task_instance(load_scenario("three_boxes", None, ["seed: 8"])[1])
    assert record["goals"] == instance.goals.tolist()
    assert record["outcome"]["num_actions"] == len(record["decisions"]) >= 2

    # The same without Meshcat, and from the record itself.
    code, again = rhp("second", "--no-meshcat", *short)
    assert code == 1
    assert without_times(again) == without_times(record)
    assert not (tmp_path / "second" / "recording.html").exists()
    path = str(tmp_path / "first" / "run.json")
    _, replayed = rhp("third", "--no-meshcat", path, "--name", "scenario")
    assert without_times(replayed) == without_times(record)


def test_ctrl_c_keeps_the_record(rhp, monkeypatch):
    def decide(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(RandomPolicy, "decide", decide)
    code, record = rhp("stopped", "--no-meshcat", "three_boxes")
    assert code == 130
    assert record["outcome"]["status"] == "interrupted"
    assert record["outcome"]["target_distance"] is None
    assert record["goals"] is None


def test_graphviz(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(POLICY, lambda *args, **kwargs: RandomPolicy())
    path = tmp_path / "diagram.dot"
    arguments = ["rhp", "run", "three_boxes", "--graphviz", str(path)]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert info.value.code == 0
    for system in ("station", "state_estimator", "planner", "command_guard"):
        assert system in path.read_text()
    assert capsys.readouterr().out == f"Diagram: {path}\n"


def test_graphviz_is_of_the_simulated_loop(monkeypatch, tmp_path, capsys):
    path = tmp_path / "diagram.dot"
    arguments = ["three_boxes", "--hardware", "missing", "--graphviz", str(path)]
    monkeypatch.setattr("sys.argv", ["rhp", "run", *arguments])
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert info.value.code == 2
    assert capsys.readouterr().err == (
        "rhp: --graphviz: draws the simulated loop, without --hardware.\n"
    )
    assert not path.exists()


def test_scenarios_start_at_rest():
    """Bundled tasks begin with a state that the station really is in."""
    for name in ("between_two_boxes", "drag_away", "push_past_obstacle"):
        _, scenario = load_scenario(name)
        simulator = Simulator(MakeClosedLoop(scenario, RandomPolicy()))
        instance = make_task_instance(scenario)
        records = []
        run_closed_loop(
            simulator,
            instance,
            nominal_physics(3),
            seed=0,
            time_limit=0.3,
            on_decision=records.append,
        )
        difference = records[0].state - instance.initial_state
        np.testing.assert_allclose(difference, 0, atol=1e-3)
