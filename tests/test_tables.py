"""The tables of `rhp evaluate` fit into a terminal."""

import numpy as np
import pytest
from rich.console import Console

from rhp_drake.evaluation.cells import group
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import Column, Trial
from rhp_drake.evaluation.tables import (
    make_ending_table,
    make_failure_table,
    make_success_table,
)
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.planning.policy_config import POLICIES

FAILURES = (
    "out of actions",
    "object fell",
    "policy failed",
    "timed out",
    "guard fault",
    "time limit",
)
COLUMNS = [Column(policy, "best" if policy != "kdp" else "") for policy in POLICIES]


def cells_of(levels, simulated_seconds, columns=COLUMNS):
    """Of all policies: a success and each failure."""
    return group(
        [
            (
                Trial(column, level, index, 0),
                Episode(
                    outcome,
                    [0] * 16,
                    np.zeros((17, 12)),
                    [0.001] * 15 + [60.0],
                    20.0,
                    simulated_seconds,
                    "target 3.1 cm outside, 12 of 41 states seen before",
                ),
            )
            for column in columns
            for level in levels
            for index, outcome in enumerate(("succeeded", *FAILURES))
        ]
    )


def printed(table) -> list[str]:
    console = Console(width=80)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize("simulated_seconds", [0.0, 60.0])
@pytest.mark.parametrize("levels", [["high"], list(UNCERTAINTY_LEVELS)])
def test_tables_fit(levels, simulated_seconds):
    cells = cells_of(levels, simulated_seconds)
    for table in (make_success_table(cells, "title"), make_failure_table(cells)):
        lines = printed(table)
        assert "…" not in "".join(lines)
        assert sum(line.startswith("kdp_checked") for line in lines) == 1
        assert any("level" in line for line in lines) == (len(levels) > 1)
        assert not any("weights" in line for line in lines)
        rows = lines[-len(POLICIES) * len(levels) :]
        assert rows[0].startswith("kdp ")
        assert all(("medium" in row) == (i % 4 == 2) for i, row in enumerate(rows)) == (
            len(levels) > 1
        )


def test_cells():
    cells = cells_of(["high"], 60.0)
    lines = printed(make_success_table(cells, "title"))
    assert "x real" in "".join(lines)
    assert lines[-len(POLICIES)].split() == [
        *("kdp", "14.3", "(2.6-51.3)", "15.7", "16.0"),
        *("1.0", "/", "60000", "60.02", "3.0"),
    ]
    # What Table I says of GP after reinforcement learning.
    assert lines[1 - len(POLICIES)].split()[:4] == ["gp", "14.3", "(2.6-51.3)", "45.6"]
    lines = printed(make_success_table(cells_of(["high"], 0.0), "title"))
    assert "x real" not in "".join(lines)
    lines = printed(make_failure_table(cells))
    assert lines[-len(POLICIES)].split() == ["kdp", *"111111"]


def test_nothing_is_said_of_runs_that_were_not():
    none = Episode("policy failed", [], np.zeros((1, 12)))
    cells = group([(Trial(Column("kdp", ""), "none", 0, 0), none)])
    (row,) = printed(make_success_table(cells, "title"))[-1:]
    assert row.split() == ["kdp", "0.0", "(0.0-79.3)", "98.0"]


def test_no_paper_beside_other_numbers_of_objects():
    lines = printed(make_success_table(cells_of(["high"], 0.0), "title", 5))
    assert "15.7" not in lines[-len(POLICIES)]


def test_weights_have_a_column_if_there_are_several():
    columns = [Column("gp", "imitation"), Column("gp", "best")]
    lines = printed(make_success_table(cells_of(["none"], 0.0, columns), "title"))
    assert [line.split()[:2] for line in lines[-2:]] == [
        ["gp", "imitation"],
        ["gp", "best"],
    ]


def test_failures_one_by_one():
    cells = cells_of(["none"], 0.0, [Column("gp", "best")])
    lines = printed(make_ending_table(cells, 2))
    assert lines[0].strip() == "The first 2 failures of 6"
    assert "gp best" in lines[3]
    assert "out of" in lines[3]
