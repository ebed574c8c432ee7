"""The environment for Gymnasium: its rules, and what it tells."""

from pathlib import Path
import sys
import warnings

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

import rhp_drake
from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration import training_task
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.task import (
    MAX_ACTIONS,
    Action,
    TaskInstance,
    allowed_actions,
    goals_reached,
    objects_fallen,
)
from rhp_drake.value.features import features

gymnasium = pytest.importorskip("gymnasium")

ID = "rhp_drake.gymnasium_env:rhp_drake/PushInClutter-v0"
PACKAGE = Path(rhp_drake.__file__).parent
PLANS = PACKAGE / "data" / "plans.parquet"
README = PACKAGE.parent / "README.md"
# The target inside the hand's opening, its goal two pushes ahead.
EASY = TaskInstance(
    np.array([0.4, 0.0, 0.0, 0.4, 0.0, 0.0, 0.3, 0.25, 0.5]),
    np.array([[0.54, 0.0], [0.3, 0.25]]),
)
# A push to the left takes the target over the table's edge, at y = 0.4.
AT_THE_EDGE = TaskInstance(
    np.array([0.5, 0.2508, 0.0, 0.5, 0.36, 0.0]), np.array([[0.5, 0.0]])
)


def make(**options):
    return gymnasium.make(ID, **options)


def play(env, actions, **reset):
    """What `reset` and `step` return, in order."""
    results = [env.reset(**reset)]
    results += [env.step(action) for action in actions]
    return results


@pytest.mark.parametrize("options", [{}, {"world_physics": "high", "num_objects": 2}])
def test_it_is_what_gymnasium_expects(options):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(render_mode="rgb_array", **options).unwrapped)


def test_a_known_plan_reaches_the_goal():
    plans = pq.read_table(PLANS).slice(0, 3).to_pylist()
    for plan in plans:
        env = make()
        # Episode k is training task k.
        env.reset(seed=plan["seed"])
        for _ in range(plan["task"]):
            env.reset()
        steps = [env.step(action) for action in plan["actions"]]
        assert sum(reward for _, reward, *_ in steps) == -len(plan["actions"])
        assert [step[2] for step in steps] == [False] * (len(steps) - 1) + [True]
        assert not any(step[3] for step in steps)
        assert steps[-1][4]["is_success"]


def test_the_same_seed_is_the_same_episode():
    first, again, other = (
        play(make(world_physics="high"), [0, 4, 0, 2], seed=seed) for seed in (5, 5, 6)
    )
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
    assert not np.array_equal(first[0][0], other[0][0])


def test_episodes_are_training_tasks():
    env = make()
    for episode, seed in enumerate((9, None, None)):
        _, info = env.reset(seed=seed)
        instance = training_task(9, episode, 3)
        np.testing.assert_array_equal(info["state"], instance.initial_state)
        np.testing.assert_array_equal(info["goals"], instance.goals)
    _, info = env.reset(seed=9)
    np.testing.assert_array_equal(info["state"], training_task(9, 0, 3).initial_state)


def test_observations_are_the_features():
    env = make(num_objects=2)
    for observation, *_, info in play(env, [0, 4], seed=1):
        seen = features(
            torch.tensor(info["state"][None], dtype=torch.float32),
            torch.tensor(info["goals"][None], dtype=torch.float32),
        )
        np.testing.assert_array_equal(observation, seen[0].numpy())
        np.testing.assert_array_equal(
            info["action_mask"], allowed_actions(info["state"])
        )


def test_observations_stay_in_their_space():
    # Gymnasium's checker looks at them, and warns.
    env = make(world_physics="high")
    env.action_space.seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(10):
            _, info = env.reset(seed=seed)
            over = False
            while not over:
                action = env.action_space.sample(info["action_mask"])
                observation, _, terminated, truncated, info = env.step(action)
                assert observation in env.observation_space
                over = terminated or truncated


def test_given_task_is_solved():
    env = make(num_objects=2)
    (_, begin), *steps = play(env, [0, 0], options={"instance": EASY}, seed=0)
    np.testing.assert_array_equal(begin["state"], EASY.initial_state)
    np.testing.assert_array_equal(begin["goals"], EASY.goals)
    assert [step[1:4] for step in steps] == [
        (-1.0, False, False),
        (-1.0, True, False),
    ]
    assert [step[4]["is_success"] for step in steps] == [False, True]
    assert goals_reached(steps[-1][4]["state"], EASY.goals)


def test_masked_action_moves_nothing_and_costs():
    env = make(num_objects=1)
    instance = TaskInstance(
        np.array([0.78, 0.0, 0.0, 0.5, 0.0, 0.0]), np.array([[0.3, 0.0]])
    )
    (_, begin), step = play(env, [Action.FORWARD], options={"instance": instance})
    assert begin["action_mask"].tolist() == [0, 1, 1, 1, 1, 1]
    _, reward, terminated, truncated, info = step
    assert (reward, terminated, truncated) == (-1, False, False)
    np.testing.assert_array_equal(info["state"], instance.initial_state)


def test_falling_ends_the_episode_as_its_worst_end():
    env = make(num_objects=1)
    *_, last = play(env, [Action.LEFT], options={"instance": AT_THE_EDGE})
    _, reward, terminated, truncated, info = last
    assert objects_fallen(info["state"])
    assert (reward, terminated, truncated) == (-1 - MAX_ACTIONS, True, False)
    assert not info["is_success"]


def test_the_example_of_the_readme(capsys):
    if not README.exists():
        pytest.skip("the package is installed without its repository")
    section = README.read_text().partition("## As a Gymnasium environment")[2]
    exec(section.partition("```python\n")[2].partition("```")[0], {})
    assert capsys.readouterr().out.startswith(("False [", "True ["))


def test_truncation_after_all_actions():
    env = make()
    turns = [Action.COUNTERCLOCKWISE, Action.CLOCKWISE] * (MAX_ACTIONS // 2)
    _, *steps = play(env, turns, seed=2)
    assert [step[3] for step in steps] == [False] * (MAX_ACTIONS - 1) + [True]
    assert not any(step[2] for step in steps)
    assert sum(step[1] for step in steps) == -MAX_ACTIONS


def test_refusal_of_the_push_model_truncates(monkeypatch):
    env = make()
    env.reset(seed=0)

    def refuse(*_):
        raise PushModelError("no")

    monkeypatch.setattr(env.unwrapped._push_model, "step", refuse)
    _, reward, terminated, truncated, _ = env.step(Action.CLOCKWISE)
    assert (reward, terminated, truncated) == (-1, False, True)


def test_uncertain_physics_make_another_world():
    ends = [
        play(
            make(num_objects=2, world_physics=level),
            [Action.FORWARD, Action.LEFT],
            seed=3,
            options={"instance": EASY},
        )[-1][4]["state"]
        for level in ("none", "high")
    ]
    np.testing.assert_array_equal(ends[0][:3], ends[1][:3])
    assert np.abs(ends[0][3:6] - ends[1][3:6]).max() > 1e-3


def test_view_from_above():
    env = make(num_objects=2, render_mode="rgb_array")
    env.reset(options={"instance": EASY})
    before = env.render()
    assert before.shape == (480, 480, 3)
    assert before.dtype == np.uint8
    # The target's green, a third of the way up and in the middle.
    red, green, blue = before[299, 240]
    assert green > 1.5 * max(red, blue)
    env.step(Action.FORWARD)
    assert not np.array_equal(env.render(), before)
    assert make().unwrapped.render() is None


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"num_objects": 0}, "num_objects is 0; it must be at least 1."),
        ({"world_physics": "wild"}, "'wild' is not one of none, low, medium, high."),
        ({"render_mode": "ansi"}, "render_mode 'ansi' is not 'rgb_array' or None."),
    ],
)
def test_bad_arguments(options, sentence):
    from rhp_drake.gymnasium_env.environment import PushInClutterEnv

    with pytest.raises(InputError, match=sentence):
        PushInClutterEnv(**options)


def changed(state_index=0, state_value=0.4, goal=(0.54, 0.0)):
    state, goals = EASY.initial_state.copy(), EASY.goals.copy()
    state[state_index] = state_value
    goals[0] = goal
    return TaskInstance(state, goals)


@pytest.mark.parametrize(
    ("instance", "sentence"),
    [
        (AT_THE_EDGE, "must be a TaskInstance of 2 objects"),
        ("easy", "must be a TaskInstance of 2 objects, not 'easy'"),
        (changed(5, np.nan), "not finite"),
        (changed(6, 0.95), "off the table"),
        (changed(goal=(0.0, 0.0)), "off the table"),
        (changed(0, 0.95), "no action keeps the hand in the workspace"),
        (changed(4, 0.05), "bodies overlap: hand and object 0"),
        (changed(goal=(0.42, 0.0)), "met at the start"),
    ],
)
def test_bad_instances(instance, sentence):
    env = make(num_objects=2)
    with pytest.raises(InputError, match=sentence):
        env.reset(options={"instance": instance})


def test_other_bad_input():
    env = make()
    with pytest.raises(InputError, match="options: 'task' is not 'instance'"):
        env.reset(options={"task": 3})
    env.reset(seed=0)
    with pytest.raises(InputError, match="action 6 is not one of 0 to 5"):
        env.step(6)


def test_without_gymnasium(monkeypatch):
    monkeypatch.delitem(sys.modules, "rhp_drake.gymnasium_env", raising=False)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(ModuleNotFoundError, match=r"needs Gymnasium: pip .*\[gymna"):
        import rhp_drake.gymnasium_env  # noqa: F401
