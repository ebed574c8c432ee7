"""What a demonstrator makes of one training task: a plan, and all it simulated."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rhp_drake.planning.search import Search
from rhp_drake.random_streams import TRAINING, stream
from rhp_drake.task import TaskInstance, sample_instance


@dataclass(frozen=True)
class Demonstration:
    """One training task and what came of it.

    Attributes:
        seed: Under which the task was drawn.
        task: Its number; with the seed and m it gives the instance, `training_task`.
        instance: <s_init, G>.
        actions: Those that led to the goal, shape (L,); None if none did.
        states: s_0 ... s_L on that way, shape (L + 1, 3 + 3 m); s_0 alone without one.
        search: All that was simulated.
        seconds: Computation it took, on the machine that did it.
        failure: Why there was nothing to demonstrate, in a sentence; usually empty.
    """

    seed: int
    task: int
    instance: TaskInstance
    actions: np.ndarray | None
    states: np.ndarray
    search: Search
    seconds: float
    failure: str = ""


class Demonstrator(Protocol):
    """Whoever solves training tasks; it is sent to other processes.

    Its `repr` tells it from every other one: whose repr is the same does the same.
    """

    @property
    def seed(self) -> int:
        """Of the tasks and of its own draws."""
        ...

    @property
    def num_objects(self) -> int:
        """The m of its tasks."""
        ...

    def demonstrate(self, task: int) -> Demonstration:
        """Solves a task, or fails to; depends on nothing but its number."""
        ...


def training_task(seed: int, task: int, num_objects: int) -> TaskInstance:
    """The training task of this number under `seed`; there is no end of them."""
    return sample_instance(stream(seed, TRAINING, task), num_objects)
