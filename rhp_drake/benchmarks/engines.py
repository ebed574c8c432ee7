"""The engines that are compared: the push model, and those that are installed."""

from collections.abc import Callable
from importlib.metadata import version
from importlib.util import find_spec
from typing import Final

from rhp_drake.planning.receding_horizon import TransitionFunction

PUSH_MODEL: Final = "push model"


def _make_push_model(num_objects: int, refinement: float) -> TransitionFunction:
    from rhp_drake.push_model.transition import PushModel

    return PushModel(num_objects, refinement=refinement)


def _make_box2d(num_objects: int, refinement: float) -> TransitionFunction:
    from rhp_drake.benchmarks.box2d_model import Box2DModel

    return Box2DModel(num_objects, refinement)


def _make_mujoco(num_objects: int, refinement: float) -> TransitionFunction:
    from rhp_drake.benchmarks.mujoco_model import MuJoCoModel

    return MuJoCoModel(num_objects, refinement)


# By their names in the tables: the package, and the engine for m and a refinement.
_ENGINES: Final[dict[str, tuple[str, Callable[[int, float], TransitionFunction]]]] = {
    PUSH_MODEL: ("pydrake", _make_push_model),
    "Box2D": ("Box2D", _make_box2d),
    "MuJoCo": ("mujoco", _make_mujoco),
}


def available_engines() -> list[str]:
    """Names of the engines whose packages are installed, the push model first."""
    return [name for name, (package, _) in _ENGINES.items() if find_spec(package)]


def describe_engines() -> str:
    """The versions of the other engines, e.g. ``Box2D 2.3.10, mujoco none``."""
    packages = [package for _, (package, _) in list(_ENGINES.items())[1:]]
    return ", ".join(f"{p} {version(p) if find_spec(p) else 'none'}" for p in packages)


def make_engine(
    name: str, num_objects: int, refinement: float = 1
) -> TransitionFunction:
    """Makes an engine for m = `num_objects`.

    Args:
        name: One of `available_engines`.
        num_objects: m.
        refinement: How many times more steps than usual.
    """
    return _ENGINES[name][1](num_objects, refinement)
