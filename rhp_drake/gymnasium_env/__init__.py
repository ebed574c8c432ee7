"""The push model as an environment for Gymnasium; importing this registers it.

``gymnasium.make("rhp_drake.gymnasium_env:rhp_drake/PushInClutter-v0")`` imports, too.
See `environment.PushInClutterEnv`.
"""

from rhp_drake.task import MAX_ACTIONS

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "rhp_drake.gymnasium_env needs Gymnasium: "
        'pip install -c constraints.txt -e ".[gymnasium]".'
    ) from error

gymnasium.register(
    id="rhp_drake/PushInClutter-v0",
    entry_point="rhp_drake.gymnasium_env.environment:PushInClutterEnv",
    max_episode_steps=MAX_ACTIONS,
)
