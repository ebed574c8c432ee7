"""Worlds: where the actions of a policy are executed.

A world and a policy know nothing of one another.  What a policy believes about the
world is its own push model, whose physics may differ from the world's.

Another world is a class with three members and a function that makes it, here in a
file `my_lab.py`, for ``rhp evaluate --world my_lab:make_world``::

    class MyWorld:
        def __init__(self, instance, physics, seed):
            self.initial_state = instance.initial_state
        def reset(self):
            self.state = my_simulator.load(self.initial_state)
        def step(self, action):
            target = rhp_drake.task.hand_targets(self.state, action)
            self.state = my_simulator.move_hand_to(target)

    def make_world(instance, physics, seed):
        return MyWorld(instance, physics, seed)

A folder of results knows a world by this name alone: whoever changes it takes another
folder.
"""

from collections.abc import Callable
import importlib
from pathlib import Path
import sys
from typing import Protocol, TypeAlias

import numpy as np

from rhp_drake.errors import InputError
from rhp_drake.physics import ObjectPhysics
from rhp_drake.push_model.transition import PushModelError
from rhp_drake.task import TaskInstance


class WorldError(Exception):
    """The world cannot execute an action: the episode ends there, as a failure."""


class World(Protocol):
    """The world of one task instance.

    One in which time flows may also have `simulated_seconds`, the time there since the
    reset, to be noted with the episode.
    """

    @property
    def state(self) -> np.ndarray:
        """What is to be seen, everything being at rest; shape (3 + 3 m,)."""
        ...

    def reset(self) -> None:
        """Puts everything where the instance has it; comes before the first action.

        Raises:
            WorldError: If it cannot.
        """
        ...

    def step(self, action: int) -> None:
        """Executes a `task.Action`, and waits until everything is at rest.

        Raises:
            WorldError: If it cannot.
        """
        ...


# Makes a world of an instance, the physics drawn for it, and a seed for whatever else
# is random there.
WorldFactory: TypeAlias = Callable[[TaskInstance, ObjectPhysics, int], World]
# Next states (N, 3 + 3 m) of states (N, 3 + 3 m) and actions (N,).
Step: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]


class PlanarWorld:
    """A transition function as a world.

    Args:
        step: For example `PushModel.step`.
        instance: Where the world begins.

    Attributes:
        state: See `World`.
    """

    def __init__(self, step: Step, instance: TaskInstance) -> None:
        self._step = step
        self._initial_state = instance.initial_state
        self.state = instance.initial_state

    def reset(self) -> None:
        """See `World`."""
        self.state = self._initial_state

    def step(self, action: int) -> None:
        """See `World`."""
        try:
            (self.state,) = self._step(self.state[None], np.array([action]))
        except PushModelError as error:
            raise WorldError(str(error)) from error


def load_world_factory(name: str) -> WorldFactory:
    """Imports a user's factory.

    Args:
        name: ``package.module:factory``; the module may be in the current folder.

    Raises:
        InputError: If there is none of this name.
    """
    module_name, _, factory_name = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        module = importlib.import_module(module_name)
    except (ImportError, SyntaxError, TypeError, ValueError) as error:
        raise InputError(f"the world {name}: cannot be imported: {error}.") from error
    factory = getattr(module, factory_name, None)
    if not callable(factory):
        raise InputError(
            f"the world {name}: the module {module_name} has no function "
            f"{factory_name!r}."
        )
    return factory
