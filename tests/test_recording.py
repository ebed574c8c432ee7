import base64
from dataclasses import replace
import math
import re
from unittest.mock import Mock

import numpy as np
import pytest

from rhp_drake import task
from rhp_drake.evaluation.recording import record_episode
from rhp_drake.physics import BOX, CYLINDER, nominal_physics
from rhp_drake.random_streams import stream
from rhp_drake.visualization import MakeMeshcat, VisualizationConfig


@pytest.fixture(scope="module")
def meshcat():
    return MakeMeshcat(VisualizationConfig())


def make_episode(num_objects: int, num_states: int = 3):
    """The hand goes forward, turns, and pushes nothing."""
    generator = stream(num_objects, "test_recording")
    instance = task.sample_instance(generator, num_objects)
    states = np.repeat(instance.initial_state[None], num_states, axis=0)
    for k, action in enumerate([task.Action.FORWARD, task.Action.CLOCKWISE]):
        if k + 1 < num_states:
            states[k + 1 :, :3] = task.hand_targets(states[k], np.array(action))
    return states, instance.goals, nominal_physics(num_objects)


def commands(html: str) -> list[bytes]:
    """What the page tells its viewer, as in Meshcat's messages."""
    texts = re.findall(r'fetch\("data:application/octet-binary;base64,([^"]*)"', html)
    return [base64.b64decode(text) for text in texts]


def animation(html: str) -> bytes:
    """The one command that sets the animation."""
    (command,) = [c for c in commands(html) if b"set_animation" in c]
    return command


def paths(command: bytes, pattern: bytes) -> set[bytes]:
    return set(re.findall(rb"/" + pattern, command))


def test_recording_is_complete(meshcat):
    html = record_episode(meshcat, *make_episode(3))
    assert "<html>" in html
    assert not re.search(r"<(script|link|img)[^>]*\b(src|href)=", html)
    moves = animation(html)
    assert len(paths(moves, rb"episode/bodies/\d")) == 4  # The hand and three boxes.
    assert len(paths(moves, rb"overlay/goal/\d/reached")) == 3
    # The turn leaves no trace.
    assert paths(moves, rb"episode/hand_path/\d") == {b"/episode/hand_path/0"}
    drawn = b"".join(c for c in commands(html) if b"set_object" in c)
    for shape in (rb"table", rb"bodies/0/2", rb"bodies/3/0", rb"hand_path/0"):
        assert paths(drawn, rb"episode/" + shape)


def test_bodies_pass_through_the_states(meshcat):
    states, goals, physics = make_episode(2)
    spy = Mock(wraps=meshcat)
    record_episode(spy, states, goals, physics)
    poses = {
        (call.args[0], call.kwargs["time_in_recording"]): call.args[1]
        for call in spy.SetTransform.call_args_list
        if "time_in_recording" in call.kwargs
    }
    assert len(poses) == 3 * 3
    for (path, time), pose in poses.items():
        body = int(path.removeprefix("/episode/bodies/"))
        x, y, theta = states[time, 3 * body : 3 * body + 3]
        np.testing.assert_allclose(pose.translation(), [x, y, 0.0])
        heading = pose.rotation().matrix()[:2, 0]
        np.testing.assert_allclose(heading, [math.cos(theta), math.sin(theta)])


def test_bodies_have_their_shapes(meshcat):
    states, goals, physics = make_episode(2)
    sides = np.array([[0.05, 0.08], [0.07, 0.07]])
    physics = replace(physics, side_lengths=sides, shapes=(BOX, CYLINDER))
    spy = Mock(wraps=meshcat)
    record_episode(spy, states, goals, physics)
    shapes = {call.args[0]: call.args[1] for call in spy.SetObject.call_args_list}
    target, obstacle = shapes["/episode/bodies/1/0"], shapes["/episode/bodies/2/0"]
    assert (target.width(), target.depth()) == (0.05, 0.08)
    assert obstacle.radius() == 0.035
    # The U is open along x of H.
    assert [shapes[f"/episode/bodies/0/{i}"].width() for i in range(3)] == [
        pytest.approx(width) for width in (0.02, 0.08, 0.08)
    ]


def test_nothing_stays_for_the_next_episode(meshcat):
    record_episode(meshcat, *make_episode(5))
    assert not meshcat.HasPath("/episode")
    assert not meshcat.HasPath("/overlay")
    assert b"/episode" not in b"".join(commands(meshcat.StaticHtml()))

    first = record_episode(meshcat, *make_episode(2))
    record_episode(meshcat, *make_episode(5))
    again = record_episode(meshcat, *make_episode(2))
    for html in (first, again):
        everything = b"".join(commands(html))
        assert len(paths(everything, rb"episode/bodies/\d")) == 3
        assert len(paths(everything, rb"overlay/goal/\d")) == 2
    assert animation(first) == animation(again)


def test_episode_without_actions(meshcat):
    moves = animation(record_episode(meshcat, *make_episode(1, num_states=1)))
    assert len(paths(moves, rb"episode/bodies/\d")) == 2
    assert not paths(moves, rb"episode/hand_path")


def test_shapes_must_agree(meshcat):
    states, goals, physics = make_episode(3)
    for wrong in (
        (states[:, :-3], goals, physics),
        (states[0], goals, physics),
        (states, goals[:2], physics),
        (states, goals, nominal_physics(2)),
    ):
        with pytest.raises(ValueError, match="need goals of shape"):
            record_episode(meshcat, *wrong)
    with pytest.raises(ValueError, match="one state at least"):
        record_episode(meshcat, states[:0], goals, physics)
    assert not meshcat.HasPath("/episode")
