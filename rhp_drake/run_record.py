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

from rhp_drake import typed_yaml
from rhp_drake.files import write_atomically
from rhp_drake.resources import resolve
from rhp_drake.run_closed_loop import Outcome
from rhp_drake.scenario import Scenario
from rhp_drake.systems.receding_horizon_planner import DecisionRecord
from rhp_drake.task import Action

_PACKAGES: Final = ("rhp_drake", "drake", "torch", "numpy")


def make_run_record(
    scenario: Scenario,
    decisions: Sequence[DecisionRecord],
    outcome: Outcome,
    times: dict[str, Any],
) -> dict[str, Any]:
    """Everything about a run, ready for JSON.

    The same scenario gives the same record but for `times` and each decision's
    `milliseconds`.  A record is a scenario file, too: ``rhp run run.json --name
    scenario`` repeats the run.

    Args:
        scenario: In full, whatever file or defaults it came from.
        decisions: All of them, in order.
        outcome: How the run ended.
        times: What the clock on the wall said.
    """
    return {
        "scenario": typed_yaml.expand(scenario),
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
