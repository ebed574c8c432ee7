"""The Markov decision process of `rhp_drake.task`, as Gymnasium wants it."""

from typing import Any, Final

import gymnasium
from gymnasium.spaces import Box, Discrete
import numpy as np
import torch

from rhp_drake.errors import InputError
from rhp_drake.learning.demonstration import training_task
from rhp_drake.physics import UNCERTAINTY_LEVELS, draw_physics
from rhp_drake.push_model.transition import PushModel, PushModelError
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.task import (
    FAILURE_VALUE,
    NUM_ACTIONS,
    REWARD,
    TABLE_LOWER,
    TABLE_UPPER,
    TaskInstance,
    allowed_actions,
    goals_reached,
    object_positions,
    objects_fallen,
    overlapping_bodies,
)
from rhp_drake.value.features import features

# Bounds of `value.features`, whose unit of length is 0.1 m, of the hand and of an
# object.  Two points of the table are at most 1.13 m apart; no action pushes an object
# further off it than the rest.
_FAR: Final = 15.0
_HAND_HIGH: Final = [2.0, 2.0, 1.0, 1.0]
_OBJECT_HIGH: Final = [_FAR, _FAR, _FAR, 1.0, 1.0, _FAR, _FAR, _FAR]
_HAND_LOW: Final = [-2.0, -2.0, -1.0, -1.0]
_OBJECT_LOW: Final = [-_FAR, -_FAR, 0.0, -1.0, -1.0, -_FAR, -_FAR, 0.0]


class PushInClutterEnv(gymnasium.Env[np.ndarray, np.int64]):
    """Push the target, and all obstacles stay, or come back, where they were.

    *Actions*: the six of `task.HAND_ACTIONS`, along the hand's own axes.  One that is
    not allowed (`task.allowed_actions`: the hand would leave the workspace or wind up
    its wrist) moves nothing and costs the reward of any other.

    *Observations*: float32 of shape (4 + 8 m,), what the Q-network sees,
    `value.features`: the scene from the hand.  They do not count the wrist's turns, on
    which the mask depends, nor the actions left.

    *Rewards*: -1 an action, so that the return of a success is minus its actions.  The
    episode terminates at the goal, or when an object falls off the table, which costs
    another 40 (`FAILURE_VALUE`), as in learning: worse than to use up all actions.

    *Truncation*: after 40 actions (`task.MAX_ACTIONS`) if made by `gymnasium.make`, and
    in the rare case that the push model refuses a state.

    *Tasks*: episode k after ``reset(seed=s)`` is training task k under seed s, the one
    that demonstrations know by these numbers; never one for validation or evaluation.
    ``reset(options={"instance": TaskInstance(...)})`` sets another.

    *Info*: ``state``, shape (3 + 3 m,), and ``goals``, shape (m, 2), as in
    `TaskInstance`; ``action_mask``, 1 where an action is allowed, int8 of shape (6,) as
    ``action_space.sample`` takes it; ``is_success``.

    Args:
        num_objects: m, the target included.
        world_physics: How uncertain the boxes' physics are, a level of
            `physics.UNCERTAINTY_LEVELS`; drawn anew for each episode and not observed.
        render_mode: "rgb_array" for a view from above, or None.

    Raises:
        InputError: If there are no such objects, level or mode.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        num_objects: int = 3,
        world_physics: str = "none",
        render_mode: str | None = None,
    ) -> None:
        if num_objects < 1:
            raise InputError(f"num_objects is {num_objects}; it must be at least 1.")
        if world_physics not in UNCERTAINTY_LEVELS:
            known = ", ".join(UNCERTAINTY_LEVELS)
            raise InputError(f"world_physics {world_physics!r} is not one of {known}.")
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode {render_mode!r} is not 'rgb_array' or None.")
        self.render_mode = render_mode
        self.action_space = Discrete(NUM_ACTIONS)
        self.observation_space = Box(
            np.array(_HAND_LOW + num_objects * _OBJECT_LOW, dtype=np.float32),
            np.array(_HAND_HIGH + num_objects * _OBJECT_HIGH, dtype=np.float32),
        )
        self._num_objects = num_objects
        self._world_physics = world_physics
        self._push_model = PushModel(num_objects)
        self._episode = -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins the next episode, or the first one under a seed.

        Args:
            seed: Of tasks and physics; without one, ever, Gymnasium draws it.
            options: ``{"instance": TaskInstance}``, or nothing, for a training task.

        Returns:
            Observation and info.

        Raises:
            InputError: If the options hold something else, or no possible task.
        """
        super().reset(seed=seed)
        self._episode = 0 if seed is not None else self._episode + 1
        options = options or {}
        if unknown := options.keys() - {"instance"}:
            raise InputError(f"options: {unknown.pop()!r} is not 'instance'.")
        instance = options.get("instance")
        if instance is None:
            instance = training_task(
                self.np_random_seed, self._episode, self._num_objects
            )
        else:
            _check(instance, self._num_objects)
        self._state = np.array(instance.initial_state, dtype=float)
        self._goals = np.array(instance.goals, dtype=float)
        generator = stream(
            self.np_random_seed, TRAINING, self._episode, "world_physics"
        )
        self._physics = draw_physics(self._world_physics, self._state, generator)
        return self._observation(), self._info()

    def step(
        self, action: np.int64 | int
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Executes an action; see the class for what comes back.

        Raises:
            InputError: If there is no such action.
        """
        if not self.action_space.contains(action):
            raise InputError(f"action {action!r} is not one of 0 to {NUM_ACTIONS - 1}.")
        truncated = False
        if allowed_actions(self._state)[action]:
            try:
                self._state = self._push_model.step(
                    self._state[None], np.array([int(action)]), self._physics
                )[0]
            except PushModelError:
                # No deed of the agent's: long training need not die of it.
                truncated = True
        fallen = bool(objects_fallen(self._state))
        info = self._info()
        reward = REWARD + (FAILURE_VALUE if fallen else 0.0)
        terminated = fallen or info["is_success"]
        return self._observation(), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """The view from above, bytes of shape (480, 480, 3), if so made."""
        if self.render_mode is None:
            return None
        # Matplotlib is for those who look.
        from rhp_drake.gymnasium_env.top_view import draw_top_view

        return draw_top_view(self._state, self._goals, self._physics)

    def _observation(self) -> np.ndarray:
        # In single precision from the beginning, as the Q-network's own.
        states = torch.as_tensor(self._state[None], dtype=torch.float32)
        goals = torch.as_tensor(self._goals[None], dtype=torch.float32)
        return features(states, goals)[0].numpy()

    def _info(self) -> dict[str, Any]:
        state = self._state
        reached = goals_reached(state, self._goals) and not objects_fallen(state)
        return {
            "state": state.copy(),
            "goals": self._goals.copy(),
            "action_mask": allowed_actions(state).astype(np.int8),
            "is_success": bool(reached),
        }


def _check(instance: Any, num_objects: int) -> None:
    """Raises InputError unless it is a task that an episode can begin with."""
    if not isinstance(instance, TaskInstance) or instance.num_objects != num_objects:
        raise InputError(
            f"options: the instance must be a TaskInstance of {num_objects} objects, "
            f"not {instance!r}."
        )
    state, goals = instance.initial_state, instance.goals
    if not (np.isfinite(state).all() and np.isfinite(goals).all()):
        raise InputError("options: the instance has numbers that are not finite.")
    points = np.concatenate([object_positions(state), goals])
    if ((points < TABLE_LOWER) | (points > TABLE_UPPER)).any():
        raise InputError("options: an object or goal of the instance is off the table.")
    if not allowed_actions(state).any():
        raise InputError("options: no action keeps the hand in the workspace.")
    if overlaps := overlapping_bodies(state):
        raise InputError(f"options: bodies overlap: {', '.join(overlaps)}.")
    if goals_reached(state, goals):
        raise InputError("options: the goal of the instance is met at the start.")
