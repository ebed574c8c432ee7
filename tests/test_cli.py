"""The command `rhp` as its user meets it."""

import subprocess
import sys

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rhp_drake import cli
from rhp_drake.errors import InputError
from rhp_drake.evaluation import results
from rhp_drake.value.q_network import PaperQNetwork
from rhp_drake.value.weights import save_q_network

COMMANDS = (
    *(
        "run",
        "lab",
        "driver",
        "calibrate",
        "plan",
        "demos",
        "imitate",
        "reinforce",
        "evaluate",
        "report",
    ),
    *("figure4", "bench"),
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


def raising(error):
    def raise_error(*arguments, **options):
        raise error

    return raise_error


def extension_interrupted() -> ImportError:
    """What comes of Ctrl-C while an extension module is imported."""
    error = ImportError("initialization failed")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), extension_interrupted()])
def test_ctrl_c_anywhere(error, monkeypatch, capsys):
    monkeypatch.setattr("rhp_drake.scenario.load_scenario", raising(error))
    assert rhp(monkeypatch, "run", "three_boxes") == 130
    printed = capsys.readouterr()
    assert printed.err == "Stopped.\n"
    assert printed.out == ""


def test_ctrl_c_while_the_commands_are_imported():
    code = (
        "import sys\n"
        "from rhp_drake import cli\n"
        "class Interrupting:\n"
        "    def find_spec(self, *arguments):\n"
        "        raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        "cli.main()"
    )
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 130
    assert result.stderr == "Stopped.\n"


def test_commands_say_themselves_what_ctrl_c_did(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(
        "rhp_drake.learning.demonstration_folder.demonstrate_tasks",
        raising(KeyboardInterrupt()),
    )
    out = str(tmp_path / "data")
    assert rhp(monkeypatch, "demos", "--plans", "3", "--out", out) == 130
    printed = capsys.readouterr()
    assert "Stopped; the same command goes on from here." in printed.out
    assert printed.err == ""


def test_other_import_errors_are_for_developers(monkeypatch):
    error = ImportError("broken installation")
    monkeypatch.setattr("rhp_drake.scenario.load_scenario", raising(error))
    monkeypatch.setattr("sys.argv", ["rhp", "run", "three_boxes"])
    with pytest.raises(ImportError, match="broken"):
        cli.main()


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_has_help(command, monkeypatch, capsys):
    assert rhp(monkeypatch, command, "--help") == 0
    assert f"rhp {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policies", "kdp,best"], "'best' is no policy; there are kdp, gp, rhp33"),
        (["--set", "training"], "'training' is not a set of instances: "),
        (["--instances", "0"], "0 instances were asked for; the validation set has 5"),
        (["--instances", "501"], "501 instances were asked for; the validation set "),
        (["--objects", "5", "--world", "station"], "the station has 3 objects, not 5."),
        (["--world", "moon"], "'moon' is not a world: planar, station, or package"),
        (["--world", "moon:make"], "the world moon:make: cannot be imported: "),
        (
            ["--temperature", "0"],
            "policy.temperature is 0.0; it must be above 0 and finite.",
        ),
        (["--weights", "missing", "--policies", "gp"], "missing: there is no such fi"),
        (["--out", "/dev/null/out"], "/dev/null/out: no folder can be made: "),
        (["--table1"], "--table1: takes hours; --out says where to keep the results."),
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


def test_evaluate_writes_every_episode_and_report_a_page(monkeypatch, capsys, tmp_path):
    weights, out = tmp_path / "weights.safetensors", tmp_path / "out"
    save_q_network(PaperQNetwork(3), weights)
    options = [
        "--policies=gp,rhp33",
        "--levels=none, none",
        "--instances=2",
        "--workers=1",
        f"--out={out}",
    ]
    for new in (4, 0):
        assert rhp(monkeypatch, "evaluate", *options, f"--weights={weights}") == 0
        # A line may be broken.
        printed = " ".join(capsys.readouterr().out.split())
        assert "planar world, validation set, uncertainty: none" in printed
        assert f"{new} episodes in" in printed
    table = pq.read_table(out / "episodes")
    assert table["policy"].to_pylist() == ["gp", "gp", "rhp33", "rhp33"]
    assert rhp(monkeypatch, "report", str(out), "--recordings=0") == 0
    assert "report.html" in capsys.readouterr().out


def test_the_command_of_table1_is_all_of_it_unless_told_otherwise(
    monkeypatch, capsys, tmp_path
):
    seen = []

    def run_experiment(folder, experiment, workers, commit, machine):
        seen.append(experiment)
        raise InputError("enough.")

    monkeypatch.setattr(results, "run_experiment", run_experiment)
    options = ("--instances=100", "--trials=1", "--policies=rhp66", "--levels=high")
    for part in ((), options):
        command = ("evaluate", "--table1", f"--out={tmp_path / 'out'}", *part)
        assert rhp(monkeypatch, *command) == 2
        assert capsys.readouterr().err.endswith("rhp: enough.\n")
    whole, small = (experiment.batches() for experiment in seen)
    # KDP, and three policies with three networks each; four levels; batches of 20.
    assert len(whole) == 10 * 4 * 25 * 10
    assert len(small) == 3 * 1 * 5 * 1
    assert seen[0].instances == seen[1].instances == "evaluation"


def test_report_reports_bad_input(monkeypatch, capsys, tmp_path):
    assert rhp(monkeypatch, "report", str(tmp_path / "nothing")) == 2
    message = capsys.readouterr().err
    assert "nothing: is no folder of results: there is no settings.json." in message
    assert not list(tmp_path.iterdir())


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
