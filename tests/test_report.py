"""The report: numbers as counted, a page that needs nothing else, its pictures."""

from xml.etree import ElementTree

import numpy as np
import pytest
from small_experiment import experiment

from rhp_drake.evaluation import results as module
from rhp_drake.evaluation.cells import Cell, compare, group, paper_cell
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import Column, Trial
from rhp_drake.evaluation.figure4_data import Point, PointResult, write_results
from rhp_drake.evaluation.paper_results import TABLE1
from rhp_drake.evaluation.report import write_report
from rhp_drake.evaluation.results import run_experiment
from rhp_drake.frozen_instances import load_instances
from rhp_drake.physics import UNCERTAINTY_LEVELS
from rhp_drake.random_streams import VALIDATION

INSTANCES = load_instances(VALIDATION)


def episode(succeeded, index=0, seconds=0.25):
    state = INSTANCES[index].initial_state
    return Episode(
        "succeeded" if succeeded else "out of actions",
        [0, 1],
        np.array([state, state, state]),
        [seconds, seconds],
        world_seconds=1.0,
        ending="" if succeeded else "target 1.0 cm outside",
    )


def cell(successes, column="gp best", trials=2):
    policy, weights = column.split()
    return Cell(
        [
            (Trial(Column(policy, weights), "none", k // trials, k % trials), e)
            for k, e in enumerate(map(episode, successes))
        ]
    )


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Made-up results of three policies at two levels: 22 instances, 2 trials."""
    generator = np.random.default_rng(0)
    rates = {"random": 0.0, "gp": 0.5, "rhp66": 0.9}

    def run_batches(work, batches, workers):
        for batch in batches:
            rate = rates[batch.column.policy]
            yield (
                batch,
                [episode(generator.random() < rate, i) for i in batch.indices],
            )

    monkeypatch.setattr(module, "run_batches", run_batches)
    work = experiment(
        list(rates), levels=["none", "high"], num_instances=22, num_trials=2
    )
    list(run_experiment(tmp_path, work, 1, "0123abc", "a machine"))
    return tmp_path


def test_a_cell_adds_up():
    # Instances 0 to 24, two trials each; the first batch is 20 instances.
    ours = cell([True] * 30 + [False] * 20)
    assert (ours.successes, ours.trials, ours.percent) == (30, 50, 60.0)
    assert ours.rate == "60.0 (46.2-72.4)"
    assert ours.wilson == pytest.approx((46.2, 72.4), abs=0.05)
    # Batches of 75 % and 0 %: mean 37.5, Student's t with one degree of freedom.
    assert ours.plus_minus == pytest.approx(12.706 * 75 / 2, rel=1e-3)
    assert ours.seconds == pytest.approx(1.5)
    assert ours.mean_decision_milliseconds == pytest.approx(250.0)
    assert ours.causes == {"out of actions": 20}
    assert np.isnan(cell([False]).seconds)
    assert np.isnan(cell([True]).plus_minus)


def test_pairs_are_compared_in_the_trials_that_both_had():
    first, second = cell([True] * 8 + [False] * 2), cell([False] * 6)
    assert compare(first, second) == (6, 0, pytest.approx(2 * 0.5**6))
    assert compare(second, first) == (0, 6, pytest.approx(2 * 0.5**6))
    assert compare(first, first) == (0, 0, 1.0)


def test_the_papers_table():
    assert len(TABLE1) == 7
    assert all(list(column) == list(UNCERTAINTY_LEVELS) for column in TABLE1.values())
    assert paper_cell(Column("rhp66", "best"), "high").percent == 90.1
    assert paper_cell(Column("rhp66", "imitation"), "none").seconds == 17.7
    assert paper_cell(Column("kdp", ""), "low").plus_minus == 17.3
    # Nobody knows how these learned.
    assert paper_cell(Column("gp", "mine"), "none") is None
    assert paper_cell(Column("random", ""), "none") is None


def test_results_are_grouped_as_they_come(folder):
    cells = group(module.read_results(folder).episodes)
    assert [str(column) for column in cells] == ["random", "gp best", "rhp66 best"]
    assert all(of.trials == 44 for by in cells.values() for of in by.values())


def test_the_report_says_what_was_counted(folder):
    report = write_report(folder, num_recordings=0)
    cells = group(module.read_results(folder).episodes)
    ours = cells[Column("rhp66", "best")]["high"]
    markdown, page = report.markdown.read_text(), report.page.read_text()
    for text in (markdown, page):
        assert "264 episodes" in text
        assert "0123abc" in text
        assert f"{ours.percent:.1f}" in text
        assert f"{ours.percent - 90.1:+.1f}" in text
        assert "nan" not in text
    (row,) = [
        line
        for line in markdown.split("### high")[1].splitlines()
        if line.startswith("| rhp66 | best") and "44" in line
    ]
    assert "90.1 ± 2.8" in row
    first, second, _ = compare(ours, cells[Column("random", "")]["high"])
    assert f"| rhp66 best | random | {first} | {second} | < 0.001 |" in markdown


def test_the_page_needs_nothing_else(folder):
    page = write_report(folder, num_recordings=0).page.read_text()
    assert page.count('src="') == page.count('src="data:image/svg+xml;base64,') == 2
    for outside in ("<script", "http", "<link"):
        assert outside not in page
    for name in ("success", "success_by_time"):
        ElementTree.parse(folder / f"{name}.svg")
        assert (folder / f"{name}.png").stat().st_size > 10_000


def test_failures_of_the_best_policy_are_recorded(folder):
    report = write_report(folder, num_recordings=2)
    recordings = sorted((folder / "recordings").iterdir())
    assert len(recordings) == 2
    for path in recordings:
        assert path.name.startswith("rhp66_best_none_")
        assert f'href="recordings/{path.name}"' in report.page.read_text()
        assert f"(recordings/{path.name})" in report.markdown.read_text()


def test_figure4_is_part_of_it_if_it_is_there(folder):
    points = [PointResult(Point(100, 0), (12,) * 25, 20)]
    write_results(folder / "figure4/figure4.csv", points)
    assert write_report(folder, 0).page.read_text().count("<figure>") == 3
