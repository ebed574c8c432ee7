"""Our planner beside OMPL's: plans are true, searches repeatable, limits kept."""

import numpy as np
import pytest

from rhp_drake import cli
from rhp_drake.benchmarks import planners
from rhp_drake.benchmarks.planners import (
    PlannerTrial,
    check_planners,
    compare_planners,
)
from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import load_instances
from rhp_drake.planning.search import leads_to_goal
from rhp_drake.push_model.transition import PushModel
from rhp_drake.random_streams import VALIDATION, stream
from rhp_drake.task import Action, TaskInstance

# The target inside the hand's opening, its goal two steps ahead, an obstacle far away.
EASY = TaskInstance(
    np.array([0.4, 0.0, 0.0, 0.4, 0.0, 0.0, 0.3, 0.25, 0.5]),
    np.array([[0.54, 0.0], [0.3, 0.25]]),
)
OMPL_NAMES = ("rrt", "sst")


@pytest.fixture(scope="module")
def push_model():
    return PushModel(3)


def search(name, push_model, task, seed=0, **limits):
    pytest.importorskip("ompl")
    from rhp_drake.benchmarks.ompl_planners import plan_with_ompl

    return plan_with_ompl(name, push_model, task, stream(seed, "test"), **limits)


@pytest.mark.parametrize("name", OMPL_NAMES)
def test_ompl_plans_lead_to_the_goal(name, push_model):
    for seed in range(3):
        found = search(name, push_model, EASY, seed, max_transitions=20_000)
        assert leads_to_goal(push_model, EASY, found.actions)
        assert 0 < found.num_transitions < 20_000


def test_ompl_solves_a_validation_task(push_model):
    task = load_instances(VALIDATION)[2]
    found = search("rrt", push_model, task, max_transitions=30_000)
    assert leads_to_goal(push_model, task, found.actions)


@pytest.mark.parametrize("name", OMPL_NAMES)
def test_ompl_searches_are_repeatable(name, push_model):
    task = load_instances(VALIDATION)[0]
    found = [
        search(name, push_model, task, seed, max_transitions=300) for seed in (0, 0, 1)
    ]
    easy = [search(name, push_model, EASY, seed) for seed in (0, 0)]
    assert found[0].num_transitions == found[1].num_transitions
    np.testing.assert_array_equal(easy[0].actions, easy[1].actions)
    assert easy[0].num_transitions == easy[1].num_transitions


@pytest.mark.parametrize("name", OMPL_NAMES)
def test_ompl_keeps_its_limits(name, push_model):
    task = load_instances(VALIDATION)[0]
    found = search(name, push_model, task, max_transitions=30)
    assert found.actions is None
    assert 30 <= found.num_transitions < 30 + 6
    found = search(name, push_model, task, time_limit=0.0)
    assert found.actions is None
    assert found.num_transitions == 0


@pytest.mark.parametrize(
    ("actions", "leads"),
    [
        ([Action.FORWARD] * 3, True),
        ([Action.FORWARD], False),
        ([], False),
        # Out of the workspace and back.
        ([Action.BACKWARD] * 5 + [Action.FORWARD] * 8, False),
        (
            [Action.COUNTERCLOCKWISE, Action.CLOCKWISE] * 20 + [Action.FORWARD] * 3,
            False,
        ),
    ],
)
def test_what_leads_to_the_goal(actions, leads, push_model):
    assert leads_to_goal(push_model, EASY, np.array(actions, int)) == leads


def test_trials_and_results():
    results = dict(compare_planners(["rrt"], VALIDATION, 2, 1e6, seed=0, num_workers=1))
    assert list(results) == [PlannerTrial("rrt", VALIDATION, index) for index in (0, 1)]
    for result in results.values():
        assert result.solved
        assert result.num_transitions >= result.num_actions > 0
        assert 0 < result.first_seconds < result.seconds


def test_a_plan_that_leads_nowhere_solves_nothing(monkeypatch):
    nowhere = planners.Found(np.array([Action.CLOCKWISE]), 1, 0.0, 0.0)
    monkeypatch.setitem(planners.PLANNERS, "nowhere", lambda *_: nowhere)
    ((_, result),) = compare_planners(["nowhere"], VALIDATION, 1, 1.0, 0, 1)
    assert not result.solved


def test_a_plan_in_time_counts_though_its_improvement_ends_late(monkeypatch):
    actions = np.array([Action.FORWARD] * 3)
    monkeypatch.setattr(planners, "load_instances", lambda _: [EASY])
    for first_seconds, solved in ((0.5, True), (1.5, False)):
        found = planners.Found(actions, 1, 2.0, first_seconds)
        monkeypatch.setitem(planners.PLANNERS, "late", lambda *_, found=found: found)
        ((_, result),) = compare_planners(["late"], VALIDATION, 1, 1.0, 0, 1)
        assert result.solved == solved
        assert result.seconds == 2
        assert result.first_seconds == first_seconds


def test_bad_planners(monkeypatch):
    with pytest.raises(InputError, match="'best' is not one of rrt, rrt_first, best_f"):
        check_planners(["rrt", "best"])
    monkeypatch.setattr(planners, "find_spec", lambda _: None)
    check_planners(["rrt"])
    with pytest.raises(InputError, match=r"ompl_sst needs OMPL: pip .*\[bench\]"):
        check_planners(["rrt", "ompl_sst"])


def test_command(monkeypatch, capsys):
    options = ["--planners=rrt,rrt", "--count=2", "--workers=1", "--time-limit=20"]
    monkeypatch.setattr("sys.argv", ["rhp", "bench", "planners", *options])
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert not info.value.code
    printed = capsys.readouterr().out
    assert "First 2 instances of the validation set" in printed
    assert "within 20 s" in printed
    # Named twice, it runs once.
    assert "(34.2-100.0)" in printed


def test_command_without_ompl(monkeypatch, capsys):
    monkeypatch.setattr(planners, "find_spec", lambda _: None)
    monkeypatch.setattr("sys.argv", ["rhp", "bench", "planners"])
    with pytest.raises(SystemExit) as info:
        cli.main()
    assert info.value.code == 2
    assert capsys.readouterr().err.startswith("rhp: --planners: ompl_rrt needs OMPL")
