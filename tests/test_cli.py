import json
import subprocess
import sys

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rhp_drake import cli
from rhp_drake.value.q_network import PaperQNetwork
from rhp_drake.value.weights import save_q_network

COMMANDS = (
    *("run", "plan", "demos", "imitate", "reinforce", "evaluate", "figure4"),
    "bench",
)


def rhp(monkeypatch, *arguments) -> int:
    """Runs the command line in this process, and returns its exit status."""
    monkeypatch.setattr("sys.argv", ["rhp", *arguments])
    with pytest.raises(SystemExit) as info:
        cli.main()
    return info.value.code or 0


def test_help_needs_neither_drake_nor_torch():
    """They take seconds to import."""
    code = (
        "import sys\n"
        "from rhp_drake import cli\n"
        "sys.argv = ['rhp', '--help']\n"
        "try:\n"
        "    cli.main()\n"
        "except SystemExit:\n"
        "    heavy = {'pydrake', 'torch', 'scipy', 'matplotlib'}\n"
        "    print('imported', sorted(heavy & {*sys.modules}))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert "imported []" in result.stdout
    for command in COMMANDS:
        assert f" {command} " in result.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_help(command, monkeypatch, capsys):
    assert rhp(monkeypatch, command, "--help") == 0
    assert f"rhp {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policies", "kdp,best"], "--policies: 'best' is not one of kdp, gp, rhp3"),
        (["--instances", "training"], "'training' is not a set of instances: "),
        (["--count", "0"], "0 instances were asked for; the validation set has 500."),
        (["--count", "501"], "501 instances were asked for; the validation set has"),
        (["--objects", "5", "--world", "station"], "the station has 3 objects, not 5."),
        (["--world", "moon"], "'moon' is not a world: planar, station."),
        (
            ["--temperature", "0"],
            "policy.temperature is 0.0; it must be above 0 and finite.",
        ),
        (["--weights", "missing", "--policies", "gp"], "missing: there is no such fi"),
        (["--out", "/dev/null/out.json"], "/dev/null: no folder can be made: "),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_evaluate_reports_bad_input(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert rhp(monkeypatch, "evaluate", "--workers", "1", *arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"rhp: {message}")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--seed=-1", "--workers=0", "--unknown"])
def test_impossible_options(option, monkeypatch, capsys):
    assert rhp(monkeypatch, "evaluate", option) == 2
    assert option.split("=")[0] in capsys.readouterr().err


def test_evaluate_writes_every_episode(monkeypatch, capsys, tmp_path):
    weights, out = tmp_path / "weights.safetensors", tmp_path / "out.json"
    save_q_network(PaperQNetwork(3), weights)
    options = [
        "--policies=gp,rhp33",
        "--levels=none,none",
        "--count=2",
        "--workers=1",
        f"--out={out}",
    ]
    assert rhp(monkeypatch, "evaluate", *options, f"--weights={weights}") == 0
    # A title may be broken into lines.
    printed = " ".join(capsys.readouterr().out.split())
    assert "first 2 instances of the validation set, uncertainty: none" in printed
    episodes = json.loads(out.read_text())
    trials = [(episode["policy"], episode["index"]) for episode in episodes]
    assert trials == [("gp", 0), ("gp", 1), ("rhp33", 0), ("rhp33", 1)]
    for episode in episodes:
        assert len(episode["decision_seconds"]) == episode["num_actions"]


def test_demos_makes_checks_compacts_and_rebuilds(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    make = ("demos", "--plans", "3", "--first-task", "7", "--out", "data")
    for _ in range(2):  # The second time, nothing is left to do.
        assert rhp(monkeypatch, *make, "--workers", "1") == 0
        printed = capsys.readouterr().out
        assert "3 tasks, 100.0" in printed
        assert "plans an hour and core" in printed
    (shard,) = (tmp_path / "data").glob("*.parquet")
    assert rhp(monkeypatch, "demos", "verify", "data", "--workers", "1") == 0
    printed = capsys.readouterr().out
    assert "3 of 3 plans reach the goal again." in printed
    assert "3 of 3 go through the stored states" in printed
    assert rhp(monkeypatch, "demos", "compact", "data", "--out", "c.parquet") == 0
    assert rhp(monkeypatch, "demos", "rebuild", "c.parquet", "--out", "r.parquet") == 0
    assert rhp(monkeypatch, "demos", "verify", "c.parquet", "r.parquet") == 0
    assert "6 of 6 plans reach the goal again." in capsys.readouterr().out

    # Plans for other tasks do not reach these tasks' goals.
    table = pq.read_table(shard)
    tasks = table.column_names.index("task")
    other = table.set_column(tasks, "task", pa.array([100, 101, 102]))
    pq.write_table(other, shard)
    assert rhp(monkeypatch, "demos", "verify", "data", "--workers", "1") == 1
    assert "0 of 3 plans reach the goal again." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--plans 3", "rhp demos: --plans and --out say what to make, and where."),
        ("--plans 3 --out /dev/null/x", "/dev/null/x: no folder can be made: "),
        ("--plans 3 --out x --method guided", "--method guided: needs --weights."),
        ("--plans 3 --out x --weights w", "--weights: the RRT needs none; "),
        ("--plans 3 --out x --method rhp --weights w", "w: there is no such file "),
        ("verify nothing", "nothing: there is no such file."),
        ("verify .", ". holds no demonstrations (tasks_*.parquet)."),
        ("compact nothing --out x", "nothing: there is no such file."),
        ("rebuild nothing --out x", "nothing: there is no such file."),
    ],
)
def test_demos_reports_bad_input(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert rhp(monkeypatch, "demos", *arguments.split()) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"rhp: {message}")
    assert not list(tmp_path.iterdir())
