"""`rhp plan` as its user meets it."""

from dataclasses import replace
from datetime import datetime
import json

import numpy as np
import pytest

from rhp_drake import cli
from rhp_drake.planning.kinodynamic_rrt import plan as grow_tree
from rhp_drake.planning.search import Growth, Plan, SearchRecord

EASY = """
easy:
  task: !Layout
    hand: {position: [0.35, 0.0]}
    target: {position: [0.42, 0.0]}
    goal: [0.56, 0.0]
    obstacles:
      - position: [0.3, 0.2]
      - position: [0.3, -0.2]
"""
SHORT = ("--no-realtime", "--scenario-text", "{time_limit: 1.0e-3}")
PLAN = "rhp_drake.planning.kinodynamic_rrt.plan"


@pytest.fixture
def rhp(monkeypatch, tmp_path):
    """Runs rhp on the easy scenario in this process; returns the exit status."""
    (tmp_path / "easy.yaml").write_text(EASY)

    def run_rhp(command, *arguments):
        scenario = str(tmp_path / "easy.yaml")
        monkeypatch.setattr("sys.argv", ["rhp", command, scenario, *arguments])
        with pytest.raises(SystemExit) as info:
            cli.main()
        return info.value.code or 0

    monkeypatch.chdir(tmp_path)
    return run_rhp


def read(path) -> dict:
    """A plan.json or run.json without its times."""
    record = json.loads(path.read_text())
    del record["times"]
    for decision in record.get("decisions", ()):
        del decision["milliseconds"]
    return record


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_same_seed_same_plan(rhp, tmp_path, capsys):
    options = ("--no-meshcat", "--no-execute")
    for out in ("a", "b"):
        assert rhp("plan", *options, "--seed", "1", "--out", out) == 0
        assert names(tmp_path / out) == ["plan.json"]
    a, b = (read(tmp_path / out / "plan.json") for out in "ab")
    assert a == b
    assert a["seed"] == 1
    assert a["scenario"]["policy"] == {"_tag": "!OpenLoopConfig", "time_limit": 120.0}
    assert len(a["states"]) == len(a["actions"]) + 1
    printed = capsys.readouterr()
    assert printed.err == ""
    last = f"{len(a['actions'])}   {a['actions'][-1]}"
    assert last in printed.out
    assert f"trees, a plan of {len(a['actions'])} actions" in printed.out


@pytest.mark.parametrize("flag", ["--open-loop", "--checked"])
def test_executes_the_plan_it_shows(flag, rhp, tmp_path, capsys):
    options = ("--no-meshcat", "--no-realtime", "--out")
    assert rhp("plan", flag, *options, "first") == 0
    assert names(tmp_path / "first") == ["plan.json", "run.json"]
    shown = read(tmp_path / "first" / "plan.json")
    run = read(tmp_path / "first" / "run.json")
    executed = [decision["action"] for decision in run["decisions"]]
    assert executed == shown["actions"]
    assert run["decisions"][0]["state"] == shown["states"][0]
    assert run["scenario"] == shown["scenario"]
    assert "Succeeded: all objects are at their goals." in capsys.readouterr().out
    # Its record is the scenario of the same run.
    (tmp_path / "easy.yaml").write_text((tmp_path / "first" / "run.json").read_text())
    assert rhp("run", "--name", "scenario", *options, "again") == 0
    assert read(tmp_path / "again" / "run.json") == run


def test_recording_shows_the_tree(rhp, tmp_path, monkeypatch, capsys):
    drawn = []
    monkeypatch.setattr(
        "rhp_drake.commands.tree_drawing.draw_bands",
        lambda meshcat, path, *arguments: drawn.append(path),
    )
    assert rhp("plan", "--no-execute", "--out", "out") == 0
    assert names(tmp_path / "out") == ["plan.json", "recording.html"]
    assert "Meshcat: http://localhost:" in capsys.readouterr().out
    assert "/overlay/tree/1/1/target" in drawn


@pytest.fixture
def shown_from(monkeypatch):
    times = []
    monkeypatch.setattr(
        "rhp_drake.commands.tree_drawing.TreeDrawing.show_from",
        lambda drawing, time: times.append(time),
    )
    return times


@pytest.mark.parametrize("exception", [None, KeyboardInterrupt])
def test_a_search_in_vain_is_shown_when_it_began(
    exception, rhp, monkeypatch, shown_from
):
    searches = []

    def plan(push_model, state, *arguments, **options):
        searches.append(state)
        if len(searches) > 1:
            if exception is not None:
                raise exception
            options["time_limit"] = 0.0
        found = grow_tree(push_model, state, *arguments, **options)
        # Nothing is where the plan expects it: the next decision plans anew.
        return replace(found, states=found.states + 1.0)

    monkeypatch.setattr(PLAN, plan)
    status = rhp("plan", "--checked", "--no-realtime", "--out", "out")
    assert status == (1 if exception is None else 130)
    assert len(searches) == 2
    first, second = shown_from
    assert second > first + 0.5


def test_no_plan(rhp, tmp_path, capsys):
    assert rhp("plan", "--no-meshcat", "--time-limit", "1e-9", "--out", "out") == 1
    assert "no plan" in capsys.readouterr().out
    shown = read(tmp_path / "out" / "plan.json")
    assert shown["actions"] is None
    assert len(shown["states"]) == 1
    assert read(tmp_path / "out" / "run.json")["outcome"]["status"] == "policy_failed"


def test_says_how_near_the_target_came(rhp, tmp_path, monkeypatch, capsys):
    def plan(push_model, state, goals, *arguments, on_growth, **options):
        # The target's distance from its goal, and the first obstacle's, m.
        for target, obstacle in ((0.09, 0.0), (0.01, 0.07), (0.08, 0.05), (0.1, 0.0)):
            child = state.copy()
            child[3:5] = goals[0] + [target, 0.0]
            child[6:8] = goals[1] + [obstacle, 0.0]
            on_growth(Growth(1, 1, 1, state, child[None], None))
        on_growth(Growth(1, 1, 1, state, np.empty((0, len(state))), None))
        return Plan(None, state[None], SearchRecord(len(state)).search(), 1.0, np.nan)

    monkeypatch.setattr(PLAN, plan)
    assert rhp("plan", "--no-meshcat", "--out", "out") == 1
    assert "target at best 8.0 cm from its goal" in capsys.readouterr().out


def test_a_folder_never_mixes_runs(rhp, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("run.json", "recording.html", "notes.txt"):
        (out / name).write_text("earlier")
    assert rhp("plan", "--no-meshcat", "--no-execute", "--out", "out") == 0
    assert names(out) == ["notes.txt", "plan.json"]
    assert rhp("run", "--no-meshcat", "--policy", "random", *SHORT, "--out", "out") == 1
    assert names(out) == ["notes.txt", "run.json"]


def test_runs_of_the_same_second_have_folders_of_their_own(rhp, tmp_path, monkeypatch):
    class Clock(datetime):
        @classmethod
        def now(cls):
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr("rhp_drake.commands.task_run.datetime", Clock)
    for _ in range(3):
        assert rhp("run", "--no-meshcat", "--policy", "random", *SHORT) == 1
    folders = names(tmp_path / "runs")
    assert folders == [f"2026-01-02_03-04-05{end}" for end in ("", "_2", "_3")]
    for folder in folders:
        assert names(tmp_path / "runs" / folder) == ["run.json"]


def test_ctrl_c_in_the_search(rhp, tmp_path, monkeypatch, capsys):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(PLAN, interrupted)
    assert rhp("plan", "--no-meshcat", "--no-execute", "--out", "out") == 130
    printed = capsys.readouterr().out
    assert "There is no plan: the search did not come to its end." in printed
    assert "Interrupted: stopped by the user." in printed
    assert names(tmp_path / "out") == []


def test_no_search_began(rhp, capsys):
    # Before anything is measured to be at rest.
    options = ("--no-meshcat", "--scenario-text", "{time_limit: 1.0e-3}")
    assert rhp("plan", *options, "--out", "out") == 1
    printed = capsys.readouterr().out
    assert "There is no plan: no search began." in printed
    assert "Time limit: not done after 0.001 s in the world." in printed


@pytest.mark.parametrize(
    ("flag", "kind", "limit"),
    [
        ("--open-loop", "OpenLoopConfig", 30.0),
        ("--checked", "CheckedPlanConfig", 30.0),
        ("--checked", "OpenLoopConfig", 120.0),
    ],
)
def test_default_limit_of_time(flag, kind, limit, rhp, tmp_path):
    text = f"{{policy: !{kind} {{time_limit: 30.0}}}}"
    options = ("--no-meshcat", "--no-execute", "--scenario-text", text)
    assert rhp("plan", flag, *options, "--out", "out") == 0
    policy = read(tmp_path / "out" / "plan.json")["scenario"]["policy"]
    assert policy["time_limit"] == limit


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--name", "hard"], "has no scenario 'hard', only easy."),
        (["--seed", "-1"], "easy: seed: must be at least 0, not -1."),
        (["--time-limit", "0"], "policy.time_limit is 0.0; it must be above 0 and fin"),
        (["--scenario-text", "{taks: 1}"], "taks: there is no such key"),
        (["--out", "/dev/null/out"], "/dev/null/out: no folder can be made: "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_input(arguments, message, rhp, tmp_path, capsys):
    assert rhp("plan", "--no-meshcat", *arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert names(tmp_path) == ["easy.yaml"]
