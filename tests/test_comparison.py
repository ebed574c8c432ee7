"""The tables of `rhp evaluate` fit into a terminal."""

import pytest
from rich.console import Console

from rhp_drake.evaluation.comparison import (
    PLANAR,
    Comparison,
    Trial,
    make_failure_table,
    make_table,
    run_comparison,
)
from rhp_drake.evaluation.episode import Episode
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.planning.policy_config import POLICIES, GreedyConfig
from rhp_drake.random_streams import VALIDATION
from rhp_drake.value.q_network import SetQNetwork
from rhp_drake.value.weights import save_q_network

FAILURES = (
    "out of actions",
    "object fell",
    "policy failed",
    "timed out",
    "guard fault",
    "time limit",
)


def results_of(levels, simulated_seconds):
    """Of all policies: a success and each failure."""
    return [
        (
            Trial(policy, level, index),
            Episode(outcome, 16, [0.001] * 15 + [60.0], simulated_seconds, 20.0),
        )
        for policy in POLICIES
        for level in levels
        for index, outcome in enumerate(("succeeded", *FAILURES))
    ]


def printed(table) -> list[str]:
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize("simulated_seconds", [0.0, 60.0])
@pytest.mark.parametrize("levels", [["high"], list(UNCERTAINTY_LEVELS)])
def test_tables_fit(levels, simulated_seconds):
    results = results_of(levels, simulated_seconds)
    for table in (make_table(results, "title"), make_failure_table(results)):
        lines = printed(table)
        assert "…" not in "".join(lines)
        assert sum(line.startswith("kdp_checked") for line in lines) == 1
        assert any("level" in line for line in lines) == (len(levels) > 1)
        rows = lines[-len(POLICIES) * len(levels) :]
        assert rows[0].startswith("kdp ")
        assert all(("medium" in row) == (i % 4 == 2) for i, row in enumerate(rows)) == (
            len(levels) > 1
        )


def test_numbers_of_objects_in_turn(tmp_path):
    """Also in one process, which keeps what it made."""
    weights = tmp_path / "weights.safetensors"
    save_q_network(SetQNetwork(3), weights)
    config = GreedyConfig(q_network=str(weights))
    for num_objects in (1, 3, 5):
        comparison = Comparison(
            {"gp": config}, ["none"], VALIDATION, num_objects, 1, PLANAR, 0
        )
        ((_, episode),) = run_comparison(comparison, 1)
        assert episode.outcome in ("succeeded", "out of actions", "object fell")


def test_cells():
    lines = printed(make_table(results_of(["high"], 60.0), "title"))
    assert "x real" in "".join(lines)
    assert lines[-len(POLICIES)].split() == [
        *("kdp", "14.3", "(2.6-51.3)", "15.7", "16.0"),
        *("1.0", "/", "60000", "60.02", "3.0"),
    ]
    lines = printed(make_table(results_of(["high"], 0.0), "title"))
    assert "x real" not in "".join(lines)
    lines = printed(make_failure_table(results_of(["high"], 0.0)))
    assert lines[-len(POLICIES)].split() == ["kdp", *"111111"]
