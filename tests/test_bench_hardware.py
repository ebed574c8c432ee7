"""The benches of the hardware side: what they conclude from what they saw."""

from dataclasses import asdict, replace
import json
import math

import numpy as np
import pytest

from rhp_drake.benchmarks import fault_campaign, loopback
from rhp_drake.benchmarks.fault_campaign import (
    Injection,
    _bad_command,
    _kind,
    _verdict,
    read_injections,
    run_campaign,
    summarize,
)
from rhp_drake.benchmarks.fault_kinds import FAULT_KINDS
from rhp_drake.benchmarks.lab_process import LabLog
from rhp_drake.benchmarks.loopback import run_both_ways
from rhp_drake.errors import InputError
from rhp_drake.lab.faults import FAULTS
from rhp_drake.safety import Fault
from rhp_drake.station.hardware_station import HardwareConfig
from rhp_drake.station.ports import COMMAND_PERIOD
from rhp_drake.station.ur5_kinematics import inverse_kinematics

HOST = "127.0.0.28"  # Of this module alone.
START = inverse_kinematics(np.array([0.5, 0.0, 0.2]))


def log(commands=(START,), positions=(START,)):
    """Of a lab in which these commands were taken, and the arm was there."""
    speeds = np.zeros(len(positions))
    if len(positions) > 1:
        steps = np.abs(np.diff(positions, axis=0)).max(axis=1)
        speeds[1:] = steps / COMMAND_PERIOD
    return LabLog(
        times=10.0 + COMMAND_PERIOD * np.arange(len(positions)),
        positions=np.array(positions),
        speeds=speeds,
        command_times=COMMAND_PERIOD * np.arange(len(commands)),
        commands=np.array(commands),
        stop_reason="",
    )


def injection(kind, **changes):
    values = {
        "index": 0,
        "kind": kind,
        "moving": True,
        "said": "",
        "hold_ms": math.nan,
        "num_commands": 9,
        "bad_command": "",
        "problem": "",
        "lab_gap_ms": 9.0,
        "false_alarms": [],
    }
    return Injection(**values | changes)


def test_all_kinds_come_before_any_comes_again():
    number = len(FAULT_KINDS)
    for turn in range(2):
        kinds = {_kind(turn * number + i, seed=3) for i in range(number)}
        assert kinds == set(FAULT_KINDS)
    assert _kind(5, seed=3) == _kind(5, seed=3)


def test_each_kind_is_done_in_words_that_the_lab_knows():
    class Lab:
        def inject(self, text):
            word, *arguments = text.split()
            assert len(arguments) == len(FAULTS[word].arguments)
            said.append(text)
            return 1.0

    class Run:
        def send_signal(self, number, driver=None):
            said.append(driver)

        def spoil_commands(self, how):
            said.append(how)

    said = []
    for kind in FAULT_KINDS.values():
        kind.inject(Lab(), Run(), np.random.default_rng(0))
        assert Fault.NONE not in kind.causes
    assert len(said) >= len(FAULT_KINDS)


@pytest.mark.parametrize(
    ("kind", "said", "hold_ms", "verdict"),
    [
        ("tracker: silent", Fault.STALE_POSE, 149.0, ""),
        ("tracker: silent", Fault.STALE_POSE, 151.0, "the arm held too late"),
        ("tracker: silent", Fault.NONE, math.nan, "the run went on"),
        ("tracker: silent", Fault.HAND_OUTSIDE, 20.0, "another cause was named"),
        ("tracker: 10 to 30 % lost", Fault.NONE, math.nan, ""),
        ("tracker: 10 to 30 % lost", Fault.STALE_POSE, 400.0, ""),
        (
            "tracker: 10 to 30 % lost",
            Fault.NOT_FINITE,
            20.0,
            "another cause was named",
        ),
        ("ours: kill -9, the loop", Fault.NONE, 100.0, ""),
        ("ours: kill -9, the loop", Fault.NONE, 200.0, "the arm held too late"),
    ],
)
def test_verdicts(kind, said, hold_ms, verdict):
    assert _verdict(FAULT_KINDS[kind], said, hold_ms) == verdict


def test_the_arm_holds_from_when_it_is_where_it_stays():
    there = START + 0.01
    # Half a milliradian is no motion.
    positions = [START, START + 0.005, there + 0.0005, there, there]
    assert log(positions=positions).holds_from() == pytest.approx(
        10.0 + 1 * COMMAND_PERIOD
    )
    assert log(positions=[START, START]).holds_from() == -math.inf
    assert log(positions=positions).moves_at(10.0 + COMMAND_PERIOD)
    assert not log(positions=positions).moves_at(10.0 + 4 * COMMAND_PERIOD)


PAN = np.array([1.0, 0, 0, 0, 0, 1.0])


@pytest.mark.parametrize(
    ("commands", "verdict"),
    [
        ([], ""),
        ([START, START + 0.011 * PAN], ""),
        ([START, START + 0.05 * PAN], "too fast"),
        ([START + i * 0.02 * PAN for i in range(8)], "too fast"),
        ([START, START * math.nan], "not finite"),
        ([START + 7.0], "beyond a position limit"),
        (
            [inverse_kinematics(np.array([0.5, 0.0, 0.2]), 0.05)],
            "the hand out of its workspace or height, or leaning",
        ),
        (
            [inverse_kinematics(np.array([0.5, 0.4, 0.2]))],
            "the hand out of its workspace or height, or leaning",
        ),
    ],
)
def test_commands_out_of_limits_are_found(commands, verdict):
    taken = log(commands=np.reshape(commands, (-1, 6)))
    assert _bad_command(taken, HardwareConfig()) == verdict


def test_summary():
    silent = "tracker: silent"
    rows = summarize(
        [
            injection(silent, said="STALE_POSE", hold_ms=100.0),
            injection(silent, said="STALE_POSE", hold_ms=140.0),
            injection(silent, said="STALE_POSE", hold_ms=0.0, moving=False),
            injection(silent, said="NOT_FINITE", hold_ms=120.0, problem="another"),
            injection("robot: 5 to 30 ms late"),
        ]
    )
    late, row = rows
    assert (row.kind, row.count, row.moving, row.stopped, row.named) == (
        silent,
        4,
        3,
        4,
        3,
    )
    assert row.hold_ms == (120.0, 140.0)
    assert late.stopped == 0
    assert np.isnan(late.hold_ms).all()


def test_the_lab_tells_when_it_stood_still():
    still = replace(log(positions=[START] * 5), times=np.array([0, 1, 2, 7, 9]) / 100)
    assert still.longest_gap() == pytest.approx(0.05)
    assert still.longest_gap(since=0.08) == pytest.approx(0.02)
    assert log().longest_gap() == 0.0


def test_injections_come_back_from_their_file(tmp_path):
    path = tmp_path / "injections.json"
    alarms = [("STALE_POSE", 12.5)]
    written = injection(_kind(0, seed=0), hold_ms=80.0, false_alarms=alarms)
    path.write_text(json.dumps([asdict(written)]))
    assert list(run_campaign(path, 1, seed=0)) == [written]


def test_a_file_of_another_seed_is_refused(tmp_path):
    path = tmp_path / "injections.json"
    path.write_text(json.dumps([asdict(injection(_kind(0, seed=0)))]))
    other = next(s for s in range(1, 9) if _kind(0, s) != _kind(0, 0))
    with pytest.raises(InputError, match="of another seed"):
        list(run_campaign(path, 1, seed=other))


def test_files_that_are_none(tmp_path):
    path = tmp_path / "injections.json"
    path.write_text(json.dumps([{"index": 0}]))
    with pytest.raises(InputError, match=r"injections\.json: cannot be read"):
        read_injections(path)
    path.write_text("[")
    with pytest.raises(InputError, match=r"injections\.json: cannot be read"):
        read_injections(path)


@pytest.mark.slow
def test_a_campaign_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(fault_campaign, "_HOST", HOST)
    path = tmp_path / "injections.json"
    first = list(run_campaign(path, 2, seed=1))
    again = list(run_campaign(path, 3, seed=1))
    # As text: nan is not nan.
    assert str(again[:2]) == str(first)
    assert str(read_injections(path)) == str(again)
    assert [x.problem or x.bad_command for x in again] == [""] * 3


@pytest.mark.slow
def test_a_task_over_loopback_ends_as_in_one_process(monkeypatch):
    monkeypatch.setattr(loopback, "_HOST", HOST)
    (run,) = run_both_ways(1)
    # It may take another number of actions: in real time no two runs are alike.
    assert run.in_process[0] == run.over_loopback[0]
    assert run.recomputed == run.num_decisions > 0
    assert run.periods.mean == pytest.approx(COMMAND_PERIOD, rel=0.05)
