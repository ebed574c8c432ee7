"""The task: states, actions, goals, sampling."""

import math

import numpy as np
import pytest

from rhp_drake import frozen_instances, task
from rhp_drake.errors import InputError
from rhp_drake.frozen_instances import SET_SIZE, load_instances
from rhp_drake.random_streams import EVALUATION, TRAINING, VALIDATION, stream
from rhp_drake.task import Action

STATE = np.array([0.5, 0.0, math.pi / 2, 0.5, 0.2, 0.0, 0.3, 0.0, 0.0, 0.7, 0.0, 0.0])
GOALS = np.array([[0.5, 0.26], [0.3, 0.0], [0.7, 0.0]])


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        (Action.FORWARD, [0.5, 0.05, math.pi / 2]),
        (Action.BACKWARD, [0.5, -0.05, math.pi / 2]),
        (Action.LEFT, [0.45, 0.0, math.pi / 2]),
        (Action.RIGHT, [0.55, 0.0, math.pi / 2]),
        (Action.COUNTERCLOCKWISE, [0.5, 0.0, math.pi * 2 / 3]),
        (Action.CLOCKWISE, [0.5, 0.0, math.pi / 3]),
    ],
)
def test_actions_move_the_hand_in_its_own_frame(action, expected):
    np.testing.assert_allclose(task.hand_targets(STATE, action), expected, atol=1e-12)


def test_goal_needs_every_object_in_its_region():
    inside = STATE.copy()
    inside[4] += 0.001  # The target is 5.9 cm from its goal's centre.
    assert task.goals_reached(inside, GOALS)
    for i in range(3):
        moved = inside.copy()
        moved[3 + 3 * i] += 0.07
        assert not task.goals_reached(moved, GOALS)
    batch = np.stack([inside, inside])
    assert task.goals_reached(batch, GOALS).shape == (2,)


def test_mask_keeps_the_hand_in_the_workspace():
    corner = STATE.copy()
    corner[:3] = [0.21, -0.29, 0.0]
    allowed = task.allowed_actions(corner)
    assert allowed[Action.FORWARD]
    assert allowed[Action.LEFT]
    assert not allowed[Action.BACKWARD]
    assert not allowed[Action.RIGHT]
    wound = STATE.copy()
    wound[2] = task.MAX_HEADING - 0.1
    assert not task.allowed_actions(wound)[Action.COUNTERCLOCKWISE]
    assert task.allowed_actions(wound)[Action.CLOCKWISE]


def test_object_off_the_table_has_fallen():
    assert not task.objects_fallen(STATE)
    fallen = STATE.copy()
    fallen[10] = task.TABLE_UPPER[1] + 0.001
    assert task.objects_fallen(fallen)


def test_overlaps_are_named():
    state = STATE.copy()
    assert task.overlapping_bodies(state) == []
    state[6:8] = state[9:11] + 0.03
    assert task.overlapping_bodies(state) == ["object 1 and object 2"]
    state[:2] = state[3:5] + np.array([0.0, 0.05])
    assert "hand and object 0" in task.overlapping_bodies(state)


def test_sampled_instances_are_tasks():
    for i in range(200):
        instance = task.sample_instance(stream(7, TRAINING, i))
        state, goals = instance.initial_state, instance.goals
        assert task.overlapping_bodies(state) == []
        assert not task.goals_reached(state, goals)
        assert task.allowed_actions(state).any()
        np.testing.assert_array_equal(goals[1:], task.object_positions(state)[1:])


def test_instance_shapes_must_agree():
    with pytest.raises(ValueError, match="initial state of shape"):
        task.TaskInstance(np.zeros(9), np.zeros((3, 2)))


def test_frozen_sets_are_what_their_streams_draw_and_never_meet():
    sets = {name: load_instances(name) for name in (EVALUATION, VALIDATION)}
    for name, instances in sets.items():
        assert len(instances) == SET_SIZE
        for i in (0, 250, 499):
            drawn = task.sample_instance(stream(0, name, i))
            np.testing.assert_allclose(instances[i].initial_state, drawn.initial_state)
    starts = [
        tuple(instance.initial_state)
        for instances in sets.values()
        for instance in instances
    ]
    starts += [
        tuple(task.sample_instance(stream(0, TRAINING, i)).initial_state)
        for i in range(SET_SIZE)
    ]
    assert len(set(starts)) == 3 * SET_SIZE


def test_sets_for_other_numbers_of_objects():
    five = load_instances(EVALUATION, 5)
    assert len(five) == SET_SIZE
    assert {instance.num_objects for instance in five} == {5}
    first = [
        tuple(load_instances(name, 5)[0].initial_state)
        for name in (EVALUATION, VALIDATION)
    ]
    assert first[0] != first[1]
    again = load_instances(EVALUATION, 5)[499].initial_state
    np.testing.assert_array_equal(again, five[499].initial_state)


def test_of_a_set_only_what_is_asked_for_is_drawn(monkeypatch):
    drawn = []

    def sample_instance(generator, num_objects):
        drawn.append(num_objects)
        return task.sample_instance(generator, num_objects)

    frozen_instances._draw_instance.cache_clear()
    monkeypatch.setattr(frozen_instances, "sample_instance", sample_instance)
    five = load_instances(EVALUATION, 5)
    assert len(five) == SET_SIZE
    asked = [*five[7:9], five[-1], five[7]]
    assert drawn == [5] * 3
    for instance, index in zip(asked, (7, 8, 499, 7), strict=True):
        alone = task.sample_instance(stream(0, EVALUATION, "objects", 5, index), 5)
        np.testing.assert_array_equal(instance.initial_state, alone.initial_state)
        np.testing.assert_array_equal(instance.goals, alone.goals)
    with pytest.raises(IndexError):
        five[SET_SIZE]


@pytest.mark.parametrize(
    ("num_objects", "last"),
    [
        (1, [0.6040114047492955, 0.1726189417887462]),
        (3, [0.714744747923407, 0.25581852215876755]),
        (8, [0.2930206898846948, -0.2630607290999432]),
    ],
)
def test_drawn_tasks_stay_the_same(num_objects, last):
    """Results name tasks by their numbers alone."""
    instance = task.sample_instance(stream(7, TRAINING, 3), num_objects)
    np.testing.assert_allclose(instance.initial_state[-3:-1], last)


@pytest.mark.parametrize("num_objects", [20, 200])
def test_too_many_objects_are_an_error(monkeypatch, num_objects):
    monkeypatch.setattr(task, "_MAX_TRIALS", 300)
    with pytest.raises(InputError, match=f"{num_objects} objects do not fit"):
        task.sample_instance(stream(7, TRAINING, 0), num_objects)


def test_streams_depend_on_seed_and_path_alone():
    def draw(*path):
        return stream(*path).random(4).tolist()

    assert draw(3, "decision", 7) == draw(3, "decision", 7)
    others = [
        draw(4, "decision", 7),
        draw(3, "decision", 8),
        draw(3, "decisions", 7),
        draw(3, "decision", 7, 0),
        draw(3, 7, "decision"),
    ]
    assert draw(3, "decision", 7) not in others
    with pytest.raises(ValueError, match="negative"):
        stream(-1, "decision")
