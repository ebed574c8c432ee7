"""The record of a run: what was asked for, what was decided, how it ended."""

from collections.abc import Sequence
from dataclasses import asdict
import hashlib
from importlib.metadata import PackageNotFoundError, version
import json
import math
from pathlib import Path
import platform
import subprocess
from typing import Any, Final

import numpy as np

from rhp_drake import typed_yaml
from rhp_drake.errors import InputError
from rhp_drake.files import write_atomically
from rhp_drake.resources import resolve
from rhp_drake.run_closed_loop import Outcome
from rhp_drake.scenario import Scenario
from rhp_drake.station.hardware_station import HardwareConfig
from rhp_drake.systems.receding_horizon_planner import DecisionRecord
from rhp_drake.task import Action

_PACKAGES: Final = ("rhp_drake", "drake", "torch", "numpy")


def make_run_record(
    scenario: Scenario,
    decisions: Sequence[DecisionRecord],
    outcome: Outcome,
    times: dict[str, Any],
    *,
    goals: np.ndarray | None,
    hardware: HardwareConfig | None = None,
) -> dict[str, Any]:
    """Everything about a run, ready for JSON.

    The same scenario gives the same record but for `times` and each decision's
    `milliseconds`.  A record is a scenario file, too: ``rhp run run.json --name
    scenario`` repeats the run, unless it was on hardware; see `check_simulated`.

    Args:
        scenario: In full, whatever file or defaults it came from.
        decisions: All of them, in order.
        outcome: How the run ended.
        times: What the clock on the wall said.
        goals: Centres of the goal regions, shape (m, 2), m in W; None if the run ended
            before there were any.  On hardware the scenario does not say them.
        hardware: The robot and the tracker; None for a simulation.
    """
    return {
        "scenario": typed_yaml.expand(scenario),
        "hardware": None if hardware is None else typed_yaml.expand(hardware),
        "goals": None
        if goals is None
        else [[_finite(x), _finite(y)] for x, y in goals],
        "seed": scenario.seed,
        "versions": _versions(),
        "q_network_sha256": _q_network_checksum(scenario),
        "decisions": [_decision_entry(record) for record in decisions],
        "outcome": asdict(outcome)
        | {"target_distance": _finite(outcome.target_distance)},
        "times": times,
    }


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Writes a record as JSON, all of it or nothing."""
    write_atomically(path, json.dumps(record, indent=1, allow_nan=False) + "\n")


def check_simulated(path: Path) -> None:
    """Refuses to simulate what was not simulated; whatever else `path` is, is fine.

    Raises:
        InputError: If `path` is the record of a run on hardware.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return  # No record; whoever loads it says what is wrong, if anything is.
    if isinstance(record, dict) and "outcome" in record and record.get("hardware"):
        raise InputError(
            f"{path}: this run was on hardware and began where robot and objects were, "
            "which the scenario in it does not say; `rhp run --hardware` runs it there "
            "again."
        )


def source_commit() -> str:
    """The commit of the checkout that this code is in, "unknown" outside of one.

    "-dirty" follows it if the checkout has been changed since.
    """
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return "unknown"
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        result = subprocess.run(
            command, cwd=root, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()


def _decision_entry(record: DecisionRecord) -> dict[str, Any]:
    decision = record.decision
    return {
        "index": record.index,
        "time": record.time,
        "action": Action(decision.action).name.lower(),
        "value": _finite(decision.value),
        "target_distance": record.target_distance,
        "num_roll_outs": len(decision.roll_outs),
        "state": record.state.tolist(),
        "milliseconds": record.milliseconds,
    }


def _finite(value: float) -> float | None:
    """The value, or None for nan, which JSON does not know."""
    return float(value) if math.isfinite(value) else None


def _versions() -> dict[str, str | None]:
    versions: dict[str, str | None] = {
        "commit": source_commit(),
        "python": platform.python_version(),
    }
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = None
    return versions


def _q_network_checksum(scenario: Scenario) -> str | None:
    """SHA-256 of the weights, None for a policy that has none."""
    uri = getattr(scenario.policy, "q_network", None)
    path = resolve(uri) if uri else None
    if path is None or not path.is_file():
        return None
    return hashlib.sha256(path.read_bytes()).hexdigest()
