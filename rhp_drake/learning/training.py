"""The training loop: acting where there is reinforcement, learning, checkpoints."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any, Final

import torch

from rhp_drake.learning.learner import Learner
from rhp_drake.learning.reinforcement import Reinforcement

# Steps between checkpoints.
_CHECKPOINT_PERIOD: Final = 1000


@dataclass(frozen=True)
class Acted:
    """Told by `train` while RHP acts for the learner's next steps.

    Attributes:
        num_tasks: Done in this round.
    """

    num_tasks: int


@dataclass(frozen=True)
class Stepped:
    """Told by `train` after each gradient step.

    Attributes:
        num_steps: Taken so far.
    """

    num_steps: int


def make_repeatable(seed: int) -> torch.device:
    """Sets torch so that training is the same bits on any number of cores.

    Returns:
        Where to train: the GPU if there is one.  It repeats itself, too, but not the
        processor's bits.
    """
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    if not torch.cuda.is_available():
        return torch.device("cpu")
    # What cuBLAS wants to be told to be deterministic.
    os.environ["CUBLAS_WORKSPACE_CONFIG"] = ":4096:8"
    torch.use_deterministic_algorithms(True)
    return torch.device("cuda")


def train(
    learner: Learner,
    checkpoint: Path,
    origin: dict[str, Any],
    reinforcement: Reinforcement | None = None,
) -> Iterator[Acted | Stepped]:
    """Trains to the end, from the checkpoint if there is one.

    Whoever stops at any moment, and calls this again with a new learner, gets the same
    network, and is told of the same steps, some of them twice.  The checkpoint stays;
    it is for the caller to remove once the weights are safe.

    Args:
        learner: Trains its network.
        checkpoint: The file.
        origin: What else the result depends on, see `Learner.save`.
        reinforcement: Makes experience on the way.

    Raises:
        InputError: If the checkpoint is of other work.
        WorkError: If the loss is not finite, or nothing can be written.
    """
    if checkpoint.exists():
        learner.resume(checkpoint, origin)
    # Not a generator itself: the learner is resumed before the first step is asked for.
    return _train(learner, checkpoint, origin, reinforcement)


def _train(
    learner: Learner,
    checkpoint: Path,
    origin: dict[str, Any],
    reinforcement: Reinforcement | None,
) -> Iterator[Acted | Stepped]:
    while learner.num_steps < learner.config.num_steps:
        if reinforcement is not None:
            for done in reinforcement.act():
                yield Acted(done)
        with _denormals_flushed():
            learner.step()
        # First what is told of a step, so that no checkpoint is ahead of it.
        yield Stepped(learner.num_steps)
        last = learner.num_steps == learner.config.num_steps
        if learner.num_steps % _CHECKPOINT_PERIOD == 0 or last:
            learner.save(checkpoint, origin)


@contextmanager
def _denormals_flushed() -> Iterator[None]:
    """Gradients of dead units get so small that arithmetic takes five times as long.

    Physics, which may be computed in other processes, too, is to have the same bits in
    all: so this is for learning alone.
    """
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)
