"""The engines that the push model is compared with, and the measurements."""

import itertools
import time

import numpy as np
import pytest

from rhp_drake.benchmarks.decision import measure_decisions
from rhp_drake.benchmarks.engines import available_engines, make_engine
from rhp_drake.benchmarks.pairs import (
    LEAST_MOTION,
    distances,
    errors_of_moved,
    sample_contact_pairs,
)
from rhp_drake.benchmarks.push_model import measure_accuracy, measure_threads
from rhp_drake.benchmarks.push_profile import measure_profile
from rhp_drake.frozen_instances import load_instances
from rhp_drake.random_streams import VALIDATION
from rhp_drake.task import Action, hand_targets
from rhp_drake.value.q_network import PaperQNetwork

# A box inside the hand's opening, two far away.
CAGED = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.3, 0.2, 0.5, 0.7, 0.25, 0.0])
OTHERS = {"Box2D": "Box2D", "MuJoCo": "mujoco"}


@pytest.fixture(scope="module")
def pairs():
    return sample_contact_pairs(200, 3, seed=0)


@pytest.fixture(scope="module", params=OTHERS)
def name(request):
    pytest.importorskip(OTHERS[request.param])
    return request.param


def test_contact_pairs_move_a_box(pairs):
    after = make_engine("push model", 3).step(*pairs)
    assert (distances(after, pairs[0]).max(axis=1) > LEAST_MOTION).all()


@pytest.mark.parametrize(
    ("action", "place"),
    [
        # The palm is 1 cm behind the box: of 5 cm, 4 push.
        (Action.FORWARD, [0.54, 0.0]),
        # The finger is 2 cm beside the box: of 5 cm, 3 push.
        (Action.LEFT, [0.5, 0.03]),
    ],
)
def test_caged_box_goes_as_far_as_geometry_says(name, action, place):
    after = make_engine(name, 3).step(CAGED[None], np.array([action]))[0]
    np.testing.assert_allclose(after[3:5], place, atol=2e-3)
    assert abs(after[5]) < 0.02
    np.testing.assert_allclose(after[6:], CAGED[6:], atol=1e-6)
    np.testing.assert_array_equal(after[:3], hand_targets(CAGED, action))


def test_results_are_near_those_of_finer_steps(name, pairs):
    reference = make_engine(name, 3, refinement=20).step(*pairs)
    after = make_engine(name, 3).step(*pairs)
    errors = np.concatenate(errors_of_moved(pairs[0], after, reference))
    assert errors.mean() < 0.0015
    assert np.percentile(errors, 95) < 0.004


def test_engines_converge_to_the_same(name, pairs):
    fine = [make_engine(n, 3, refinement=20).step(*pairs) for n in ("push model", name)]
    errors = np.concatenate(errors_of_moved(pairs[0], *fine))
    assert np.median(errors) < 0.0005
    assert errors.mean() < 0.0015


def test_results_hardly_depend_on_earlier_ones(name, pairs):
    states, actions = pairs
    engine = make_engine(name, 3)
    expected = engine.step(states, actions)
    backwards = engine.step(states[::-1], actions[::-1])[::-1]
    # Box2D solves contacts in the order in which its tree of bounding boxes, which has
    # a history, finds them.
    assert np.percentile(distances(backwards, expected), 95) < 1e-3


def test_accuracy_of_all_engines(pairs):
    engines = available_engines()
    accuracies = measure_accuracy(engines, (pairs[0][:8], pairs[1][:8]), 3)
    assert [(a.engine, a.refinement) for a in accuracies] == [
        (e, k) for e in engines for k in (0.5, 1, 2, 4)
    ]
    coarse, usual, _, fine = accuracies[:4]
    assert usual.slowness.median == 1
    assert fine.own.mean < usual.own.mean < coarse.own.mean


def test_profile_adds_up(pairs, monkeypatch):
    # A clock that goes on by a second whenever it is read.
    monkeypatch.setattr(time, "thread_time", itertools.count().__next__)
    profile = measure_profile((pairs[0][:20], pairs[1][:20]), 3)
    *parts, whole = profile.parts
    seconds = {part.name: part.seconds.median for part in profile.parts}
    # Between the first reading and the last: two at the checks, two at each push.
    assert whole.name == "whole push"
    assert whole.seconds.median == pytest.approx((2 + 2 * 20 + 1) / 20)
    assert seconds["checks of the input"] == pytest.approx(1 / 20)
    assert sum(part.seconds.median for part in parts) == pytest.approx(43 / 20)
    assert sum(part.share.median for part in parts) == pytest.approx(1)
    # A push has at most one for each piece of its path, and one to settle.
    assert 1 < profile.steps <= 11


def test_speed_by_threads(pairs):
    few = (pairs[0][:20], pairs[1][:20])
    one, two = measure_threads({"contact": few}, 3, [1, 2])
    assert (one.threads, two.threads) == (1, 2)
    assert one.actions_per_second.low > 0


def test_times_of_decisions():
    instances = load_instances(VALIDATION)
    (times,) = measure_decisions(PaperQNetwork(3).eval(), instances, 3, [1])
    assert times.decisions == 3
    assert 0 < times.p50 <= times.p95
    assert times.network > 0
    assert times.rest > 0
