"""The push model: against finer physics, against what is exact, and its bits."""

from concurrent.futures import ThreadPoolExecutor
import copy
from dataclasses import replace
import pickle

import numpy as np
import pytest

from rhp_drake.physics import draw_physics, nominal_physics
from rhp_drake.planar_geometry import rectangles_overlap
from rhp_drake.push_model.diagram import MakePushDiagram, limit_surface_length
from rhp_drake.push_model.touch import STEPS_PER_ACTION, first_touches
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import stream
from rhp_drake.task import (
    BOX_SIDE,
    HAND_ACTIONS,
    HAND_RECTANGLES,
    NUM_ACTIONS,
    TRANSLATION,
    Action,
    hand_targets,
    object_positions,
    overlapping_bodies,
    sample_instance,
    state_rectangles,
)

# A box inside the hand's opening, two far away.
CAGED = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.3, 0.2, 0.5, 0.7, 0.25, 0.0])


@pytest.fixture(scope="module")
def push_model():
    return PushModel(3)


@pytest.fixture(scope="module")
def pairs():
    """States with the hand near a box, and actions."""
    generator = stream(0, "test_push_model")
    states = []
    while len(states) < 120:
        state = sample_instance(generator).initial_state.copy()
        state[:2] = state[3:5] + generator.uniform(-0.1, 0.1, size=2)
        if not overlapping_bodies(state):
            states.append(state)
    return np.array(states), generator.integers(NUM_ACTIONS, size=len(states))


def test_models_and_task_describe_the_same_hand_and_box():
    diagram = MakePushDiagram(3)
    plant = diagram.plant()
    inspector = diagram.scene_graph().model_inspector()
    hand = plant.GetBodyByName("hand")
    ids = plant.GetCollisionGeometriesForBody(hand)
    described = sorted(
        [
            *inspector.GetPoseInFrame(i).translation()[:2],
            *(inspector.GetShape(i).size()[:2] / 2),
        ]
        for i in ids
    )
    np.testing.assert_allclose(described, sorted(HAND_RECTANGLES.tolist()))


def test_untouched_boxes_stay_and_the_hand_arrives(push_model):
    state = CAGED.copy()
    state[:2] = [0.3, -0.2]
    for action in Action:
        after = push_model.step(state[None], np.array([action]))[0]
        np.testing.assert_array_equal(after[3:], state[3:])
        np.testing.assert_array_equal(after[:3], hand_targets(state, action))


def test_palm_pushes_the_box_as_far_as_geometry_says(push_model):
    after = push_model.step(CAGED[None], np.array([Action.FORWARD]))[0]
    # The palm is 1 cm behind the box: of 5 cm, 4 push.
    np.testing.assert_allclose(after[3:5], [0.54, 0.0], atol=2e-3)
    assert abs(after[5]) < 0.02
    np.testing.assert_array_equal(after[6:], CAGED[6:])


def test_finger_drags_the_box_sideways(push_model):
    after = push_model.step(CAGED[None], np.array([Action.LEFT]))[0]
    # The finger is 2 cm beside the box: of 5 cm, 3 push.
    np.testing.assert_allclose(after[3:5], [0.5, 0.03], atol=2e-3)
    assert abs(after[5]) < 0.02


def test_pushes_are_near_those_of_twenty_times_finer_steps(push_model, pairs):
    states, actions = pairs
    reference = PushModel(3, refinement=20).step(states, actions)
    after = push_model.step(states, actions)
    moved = (
        np.linalg.norm(object_positions(reference) - object_positions(states), axis=-1)
        > 1e-3
    )
    errors = np.linalg.norm(
        object_positions(reference) - object_positions(after), axis=-1
    )[moved]
    assert moved.sum() > 40
    assert errors.mean() < 0.0015
    assert np.percentile(errors, 95) < 0.004


def test_bodies_do_not_end_up_inside_each_other(push_model, pairs):
    for state in push_model.step(*pairs):
        rectangles = state_rectangles(state)
        rectangles[:, 3:] -= 0.001
        for i in range(3, len(rectangles)):
            for j in range(i):
                assert not rectangles_overlap(rectangles[i], rectangles[j])


def test_bits_do_not_depend_on_batch_order_or_threads(push_model, pairs):
    states, actions = pairs
    expected = push_model.step(states, actions)
    order = stream(1, "order").permutation(len(states))
    np.testing.assert_array_equal(
        push_model.step(states[order], actions[order]), expected[order]
    )
    with PushModel(3, num_threads=2) as threaded:
        np.testing.assert_array_equal(threaded.step(states, actions), expected)
    one_by_one = [
        push_model.step(states[i : i + 1], actions[i : i + 1])[0] for i in range(20)
    ]
    np.testing.assert_array_equal(one_by_one, expected[:20])


@pytest.mark.parametrize("num_threads", [1, 2])
def test_python_threads_may_share_it(push_model, pairs, num_threads):
    expected = push_model.step(*pairs)
    with (
        PushModel(3, num_threads) as shared,
        ThreadPoolExecutor(3) as callers,
    ):
        jobs = [callers.submit(shared.step, *pairs) for _ in range(6)]
        for job in jobs:
            np.testing.assert_array_equal(job.result(), expected)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_copies_have_simulators_of_their_own(push_model, pairs, num_threads):
    expected = push_model.step(*pairs)
    with PushModel(3, num_threads) as original:
        original.step(*pairs)
        for duplicate in (copy.copy, copy.deepcopy, pickled):
            with duplicate(original) as other, ThreadPoolExecutor(2) as callers:
                jobs = [callers.submit(m.step, *pairs) for m in (original, other)]
                for job in jobs:
                    np.testing.assert_array_equal(job.result(), expected)


def pickled(model):
    """As another process gets it."""
    return pickle.loads(pickle.dumps(model))


@pytest.mark.parametrize("refinement", [0.5, 1, 20])
def test_bits_do_not_depend_on_what_was_before(pairs, refinement):
    states, actions = pairs[0][:40], pairs[1][:40]
    push_model = PushModel(3, refinement=refinement)
    expected = push_model.step(states, actions)
    backwards = push_model.step(states[::-1], actions[::-1])[::-1]
    np.testing.assert_array_equal(backwards, expected)


def test_what_is_not_touched_needs_no_physics(push_model, pairs):
    """The swept test never misses a touch that the physics would see."""
    states, _ = pairs
    actions = stream(2, "all_actions").integers(len(Action), size=len(states))
    sides = np.full((len(states), 3, 2), BOX_SIDE)
    touches = first_touches(states, actions, sides)
    free = touches == STEPS_PER_ACTION
    assert 0 < free.sum() < len(free)
    fractions = np.linspace(0, 1, 101)
    for state, action, touch in zip(states, actions, touches, strict=True):
        motion = hand_targets(state, action) - state[:3]
        moving = state.copy()
        for fraction in fractions[fractions < touch / STEPS_PER_ACTION]:
            moving[:3] = state[:3] + fraction * motion
            assert not overlapping_bodies(moving, -5e-4)


def test_mirror_image_of_a_push(push_model, pairs):
    states, _ = pairs
    mirror = np.tile([1.0, -1.0, -1.0], 4)
    left = np.full(len(states), Action.LEFT)
    right = np.full(len(states), Action.RIGHT)
    after = push_model.step(states, left)
    mirrored = push_model.step(states * mirror, right) * mirror
    difference = np.linalg.norm(
        object_positions(after) - object_positions(mirrored), axis=-1
    )
    assert np.median(difference) < 1e-4
    assert difference.mean() < 1e-3


@pytest.mark.parametrize(
    ("states", "actions", "message"),
    [
        (np.zeros((2, 10)), np.zeros(2, int), r"shape \(N, 3 \+ 3 m\)"),
        (np.zeros((2, 15)), np.zeros(2, int), "4 objects in a push model of 3"),
        (np.zeros((2, 12)), np.zeros(3, int), "as many actions"),
        (np.full((2, 12), np.nan), np.zeros(2, int), "state 0 .* not finite"),
        (np.stack([CAGED, CAGED * 0]), np.zeros(2, int), "state 1 .* inside each"),
        (np.stack([CAGED, CAGED]), np.array([0, -1]), "action 1 .* is -1"),
        (np.stack([CAGED, CAGED]), np.zeros(2), "must be integers"),
    ],
)
def test_bad_batches_are_refused(push_model, states, actions, message):
    with pytest.raises(ValueError, match=message):
        push_model.step(states, actions)


def test_physics_of_the_wrong_size_are_refused(push_model):
    states, actions = CAGED[None], np.array([Action.FORWARD])
    with pytest.raises(ValueError, match=r"physics 0 .* 2 objects"):
        push_model.step(states, actions, nominal_physics(2))
    with pytest.raises(ValueError, match="as many physics"):
        push_model.step(states, actions, [nominal_physics(3)] * 2)


def test_a_batch_may_mix_physics(push_model, pairs):
    states, actions = pairs
    generator = stream(0, "physics")
    physics = [draw_physics("high", state, generator) for state in states]
    mixed = push_model.step(states, actions, physics)
    alone = [
        PushModel(3).step(states[i : i + 1], actions[i : i + 1], physics[i])[0]
        for i in range(0, len(states), 10)
    ]
    np.testing.assert_array_equal(mixed[::10], alone)
    with PushModel(3, num_threads=2) as threaded:
        np.testing.assert_array_equal(threaded.step(states, actions, physics), mixed)
    nominal = push_model.step(states, actions, [nominal_physics(3)] * len(states))
    np.testing.assert_array_equal(nominal, push_model.step(states, actions))
    assert (mixed != nominal).any()


def test_fewer_objects_need_no_other_model(pairs):
    states, actions = pairs
    two = np.ascontiguousarray(states[:, :9])
    np.testing.assert_array_equal(
        PushModel(5).step(two, actions), PushModel(2).step(two, actions)
    )


def test_a_wide_box_is_pushed_by_its_side(push_model):
    physics = nominal_physics(3)
    physics.side_lengths[0] = [0.04, 0.09]
    after = push_model.step(CAGED[None], np.array([Action.FORWARD]), physics)[0]
    # The palm is 2 cm behind the box: of 5 cm, 3 push.
    np.testing.assert_allclose(after[3:5], [0.53, 0.0], atol=4e-3)


def test_a_cylinder_is_pushed_by_its_radius(push_model):
    physics = replace(nominal_physics(3), shapes=("cylinder", "box", "box"))
    after = push_model.step(CAGED[None], np.array([Action.FORWARD]), physics)[0]
    np.testing.assert_allclose(after[3:5], [0.54, 0.0], atol=1e-3)
    # Where a turned box's corner would be hit, a cylinder is not.
    state = CAGED.copy()
    state[:3] = [0.5, -0.106, 0.0]
    state[5] = np.pi / 4
    action = np.array([Action.FORWARD])
    box, cylinder = (
        push_model.step(state[None], action, of)[0] for of in (None, physics)
    )
    assert np.linalg.norm(box[3:5] - state[3:5]) > 1e-3
    np.testing.assert_allclose(cylinder[3:5], state[3:5], atol=1e-6)


@pytest.mark.parametrize("quantity", ["density", "support_friction"])
def test_the_heavier_or_rougher_box_resists_more(push_model, quantity):
    """A box that meets another one off its centre slides aside, the more so the more
    the other one resists."""
    state = CAGED.copy()
    state[6:9] = [0.561, 0.035, 0.0]
    asides = []
    for factor in (0.25, 1.0, 4.0):
        physics = nominal_physics(3)
        getattr(physics, quantity)[1] *= factor
        after = push_model.step(state[None], np.array([Action.FORWARD]), physics)[0]
        asides.append(state[4] - after[4])
    assert asides[0] < asides[1] < asides[2]


def test_limit_surface_of_a_rectangle():
    for x, y in [(0.06, 0.06), (0.03, 0.09)]:
        grid = (np.arange(400) + 0.5) / 400 - 0.5
        mean = np.hypot(*np.meshgrid(x * grid, y * grid)).mean()
        assert limit_surface_length(x, y) == pytest.approx(mean, rel=1e-5)


def test_boxes_smaller_than_believed_may_stand_closer(push_model):
    """A planner sees boxes of 3 cm side by side, and believes that they are larger."""
    state = CAGED.copy()
    state[6:9] = [0.5, 0.03, 0.0]
    after = push_model.step(state[None], np.array([Action.FORWARD]))[0]
    assert np.isfinite(after).all()


def test_an_empty_batch(push_model):
    assert push_model.step(np.empty((0, 12)), np.empty(0, int)).shape == (0, 12)


@pytest.mark.parametrize("action", HAND_ACTIONS)
def test_a_moved_and_turned_scene_is_pushed_the_same_way(push_model, pairs, action):
    states = pairs[0][:40]
    turned = states.reshape(-1, 4, 3) + np.array([0, 0, np.pi / 2])
    turned[..., 0], turned[..., 1] = 0.5 - states[:, 1::3], states[:, 0::3] - 0.5
    turned = turned.reshape(states.shape)
    actions = np.full(len(states), action)
    start = object_positions(states)
    ways = object_positions(push_model.step(states, actions)) - start
    turned_ways = object_positions(push_model.step(turned, actions)) - object_positions(
        turned
    )
    back = np.stack([turned_ways[..., 1], -turned_ways[..., 0]], axis=-1)
    assert np.median(np.linalg.norm(back - ways, axis=-1)) < 1e-6
    assert np.linalg.norm(back - ways, axis=-1).mean() < 1e-3


def test_a_failure_of_the_solver_names_its_state(push_model, monkeypatch):
    def fail(*arguments):
        raise SystemExit("assertion failed")  # As pydrake reports them.

    forward = CAGED[None], np.array([Action.FORWARD])
    expected = push_model.step(*forward)
    with monkeypatch.context() as context:
        context.setattr("rhp_drake.push_model.transition.Simulator.AdvanceTo", fail)
        with pytest.raises(PushModelError, match=r"0\.25.*assertion failed"):
            push_model.step(*forward)
    # It leaves no trace.
    np.testing.assert_array_equal(push_model.step(*forward), expected)


def test_swept_test_agrees_with_full_physics(push_model, monkeypatch):
    """What the swept test calls untouched stays put in a simulation of it all."""
    generator = stream(3, "full_physics")
    states = np.array([sample_instance(generator).initial_state for _ in range(300)])
    states[:, :2] = states[:, 3:5] + generator.uniform(-0.15, 0.15, size=(300, 2))
    states = states[[not overlapping_bodies(state) for state in states]]
    actions = generator.integers(len(Action), size=len(states))
    sides = np.full((len(states), 3, 2), BOX_SIDE)
    free = first_touches(states, actions, sides) == STEPS_PER_ACTION
    assert free.sum() > 30
    states, actions = states[free], actions[free]
    monkeypatch.setattr(
        "rhp_drake.push_model.transition.first_touches",
        lambda states, *_: np.zeros(len(states), dtype=int),
    )
    np.testing.assert_allclose(
        push_model.step(states, actions), states_after(states, actions), atol=1e-9
    )


def states_after(states, actions):
    """The states if only the hand moves."""
    after = states.copy()
    after[:, :3] = hand_targets(states, actions)
    return after


def test_what_was_pushed_is_at_rest(push_model, pairs):
    """After a push, a hand that goes away leaves the boxes where they are."""
    states, actions = pairs
    after = push_model.step(states, actions)
    away = after.copy()
    away[:, :2] += [2.0, 0.0]
    again = push_model.step(away, actions)
    np.testing.assert_array_equal(again[:, 3:], after[:, 3:])


def test_boxes_gain_no_motion_that_the_hand_does_not_have(push_model, pairs):
    states, _ = pairs
    for action in HAND_ACTIONS[:4]:
        after = push_model.step(states, np.full(len(states), action))
        ways = np.linalg.norm(
            object_positions(after) - object_positions(states), axis=2
        )
        # A corner that turns under the push may go further than the hand, a little.
        assert ways.max() < 1.3 * TRANSLATION


def test_boxes_do_not_pass_through_the_hand_or_each_other(push_model):
    """Ten pushes in a row: what is before the palm stays there, in order."""
    state = CAGED.copy()
    state[:6] = [0.25, 0.01, 0.0, 0.25, 0.0, 0.3]
    state[6:9] = [0.33, 0.02, 0.1]
    for _ in range(10):
        state = push_model.step(state[None], np.array([Action.FORWARD]))[0]
        palm = state[0] - 0.04
        assert palm + 0.02 < state[3]
        beside = abs(state[7] - state[4]) > 0.04
        assert beside or state[3] + 0.04 < state[6]


def test_friction_between_bodies_matters(push_model):
    state = CAGED.copy()
    state[:6] = [0.46, 0.03, 0.0, 0.525, 0.0, 0.4]
    turns = []
    for friction in (0.05, 1.0):
        physics = nominal_physics(3)
        physics.friction[0] = friction
        after = push_model.step(state[None], np.array([Action.FORWARD]), physics)[0]
        turns.append(after[5] - state[5])
    # 0.105 at a hundred times finer steps.
    assert turns[1] - turns[0] > 0.05
