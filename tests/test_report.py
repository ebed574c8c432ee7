"""The report: numbers as counted, a page that needs nothing else, its pictures."""

from xml.etree import ElementTree

import numpy as np
import pytest
from small_experiment import experiment

from rhp_drake.evaluation import report as report_module
from rhp_drake.evaluation import results as module
from rhp_drake.evaluation.cells import Cell, compare, group, paper_cell
from rhp_drake.evaluation.episode import Episode
from rhp_drake.evaluation.experiment import Column, Trial
from rhp_drake.evaluation.figure4_data import Point, PointResult, write_results
from rhp_drake.evaluation.paper_results import TABLE1
from rhp_drake.evaluation.plots import to_svg
from rhp_drake.evaluation.report import write_report
from rhp_drake.evaluation.result_plots import draw_success, draw_success_by_time
from rhp_drake.evaluation.results import run_experiment
from rhp_drake.evaluation.statistics import grouped_wilson_interval, wilson_interval
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


def cell(successes, column="gp best", trials=1):
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
    ours = cell([True] * 30 + [False] * 20)
    assert (ours.successes, ours.trials, ours.percent) == (30, 50, 60.0)
    assert ours.rate == "60.0 (46.2-72.4)"
    assert ours.wilson == pytest.approx((46.2, 72.4), abs=0.05)
    # Whole batches of 100 % and 50 %: Student's t with one degree of freedom.
    assert ours.plus_minus == pytest.approx(12.706 * 50 / 2, rel=1e-3)
    assert ours.seconds == pytest.approx(1.5)
    assert ours.mean_decision_milliseconds == pytest.approx(250.0)
    assert ours.causes == {"out of actions": 20}
    assert np.isnan(cell([False]).seconds)
    assert np.isnan(cell([True] * 39).plus_minus)


def test_a_trial_repeated_is_no_more_evidence():
    """A greedy policy does the same in each, where physics are certain."""
    once, other = [True, False] * 10, [True, True, True, False] * 5
    often, others = (np.repeat(of, 10).tolist() for of in (once, other))
    assert cell(often, trials=10).wilson == pytest.approx(cell(once).wilson)
    assert cell([True] * 200, trials=10).rate == cell([True] * 20).rate
    pair = compare(cell(often, trials=10), cell(others, trials=10))
    assert pair == compare(cell(once), cell(other)) == (0, 5, 0.0625)
    # One more of three is enough to win an instance.
    first, second = (
        cell([True, False, False] * 3, trials=3),
        cell([False] * 9, trials=3),
    )
    assert compare(first, second) == (3, 0, 0.25)


def test_independent_trials_count_in_full():
    fives = np.full(20, 5), np.full(20, 10)
    assert grouped_wilson_interval(*fives) == wilson_interval(100, 200)
    successes = np.random.default_rng(0).binomial(10, 0.8, 500)
    low, high = grouped_wilson_interval(successes, np.full(500, 10))
    assert high - low == pytest.approx(2 * 1.96 * np.sqrt(0.8 * 0.2 / 5000), rel=0.1)
    # A single instance says next to nothing.
    for number in (0, 7, 10):
        low, high = grouped_wilson_interval(np.array([number]), np.array([10]))
        assert 0 <= low <= number / 10 <= high <= 1
        assert high - low > 0.7


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
        assert "go alike" in text
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


def test_a_policy_without_failures_has_nothing_to_record(folder, monkeypatch):
    """Others have."""
    results = module.read_results(folder)
    results.episodes[:] = [
        (trial, episode(trial.column.policy == "rhp66" or trial.index > 0))
        for trial, _ in results.episodes
    ]
    monkeypatch.setattr(report_module, "read_results", lambda folder: results)
    write_report(folder, num_recordings=1)
    (path,) = (folder / "recordings").iterdir()
    assert path.name == "random_none_0_0.html"


def texts(report) -> list[str]:
    """Page and Markdown, whatever their lines."""
    return [" ".join(p.read_text().split()) for p in (report.page, report.markdown)]


def test_work_that_is_going_on_can_be_looked_at(folder):
    """Levels, policies and instances may be missing yet."""
    for text in texts(write_report(folder, 0)):
        assert "3 policies on 22 instances" in text
        assert "run alike" not in text
    for path in (folder / "episodes").iterdir():
        if "high" in path.name or path.name.startswith("gp_best_none_01_020"):
            path.unlink()
    page, markdown = texts(write_report(folder, 0))
    for text in (page, markdown):
        assert "3 policies on up to 22 instances" in text
        assert "Not all policies have been run alike" in text
    assert "### high" not in markdown
    assert ">high<" not in page
    for path in (folder / "episodes").iterdir():
        if not path.name.startswith("rhp66_best_none_00_000"):
            path.unlink()
    for text in texts(write_report(folder, 0)):
        assert "1 policy on 20 instances" in text
        assert "Pairs of policies" not in text


@pytest.mark.filterwarnings("error")
def test_a_policy_that_fails_at_once_decides_nothing():
    none = Episode("policy failed", [], np.zeros((1, 12)))
    column = Column("kdp", "")
    cells = group([(Trial(column, "none", i, 0), none) for i in range(3)])
    of = cells[column]["none"]
    assert of.rate == "0.0 (0.0-56.1)"
    assert np.isnan(of.mean_decision_milliseconds)
    assert np.isnan(of.decision_milliseconds(95))
    for figure in (draw_success(cells, with_paper=True), draw_success_by_time(cells)):
        to_svg(figure)


def legend(figure) -> list[str]:
    """What the picture's legend says."""
    (of_figure,) = figure.legends
    return [text.get_text() for text in of_figure.get_texts()]


def test_all_policies_are_in_the_legend_whatever_level_they_were_run_at():
    columns = {Column("gp", "best"): "none", Column("rhp66", "paper"): "high"}
    cells = group(
        [
            (Trial(column, level, 0, 0), episode(True))
            for column, level in columns.items()
        ]
    )
    assert legend(draw_success_by_time(cells)) == ["gp best", "rhp66 paper"]
    # The paper has three objects; beside others its numbers would mislead.
    assert legend(draw_success(cells, with_paper=False)) == ["best", "paper"]
    assert "the paper, imitation" in legend(draw_success(cells, with_paper=True))


def test_figure4_is_part_of_it_if_it_is_there(folder):
    points = [PointResult(Point(100, 0), (12,) * 25, 20)]
    write_results(folder / "figure4/figure4.csv", points)
    assert write_report(folder, 0).page.read_text().count("<figure>") == 3
