"""What learners share: gradient steps that can be stopped and gone on with."""

from abc import ABC, abstractmethod
import io
import json
from pathlib import Path
import pickle
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from rhp_drake.errors import InputError, WorkError
from rhp_drake.files import write_atomically
from rhp_drake.value.q_network import QNetwork


class LearnerConfig(Protocol):
    """What every learner has to know; the configurations are frozen dataclasses.

    Attributes:
        l2: Weight of the L2 regularisation.
        learning_rate: Of Adam at the start; it falls to 0 as a cosine.
        batch_size: Samples of a step.
        num_steps: Gradient steps.
    """

    @property
    def l2(self) -> float: ...  # noqa: D102
    @property
    def learning_rate(self) -> float: ...  # noqa: D102
    @property
    def batch_size(self) -> int: ...  # noqa: D102
    @property
    def num_steps(self) -> int: ...  # noqa: D102


class Learner(ABC):
    """Trains a Q-network in place, step by step.

    Args:
        network: Its weights are the start.
        config: How.
        generator: Everything that is drawn comes from it.

    Attributes:
        network: The same.
        config: The same.
        num_steps: Steps taken so far.
        mean_loss: Running mean of the loss.
    """

    def __init__(
        self, network: QNetwork, config: LearnerConfig, generator: np.random.Generator
    ) -> None:
        self.network = network
        self.config = config
        self.num_steps = 0
        self.mean_loss = 0.0
        self._generator = generator
        self._optimizer = torch.optim.Adam(
            network.parameters(), config.learning_rate, weight_decay=config.l2
        )
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
            self._optimizer, config.num_steps
        )

    @abstractmethod
    def _loss(self) -> torch.Tensor:
        """The loss of a batch drawn at random."""

    def _modules(self) -> dict[str, nn.Module]:
        """What has weights of its own."""
        return {"network": self.network}

    def step(self) -> None:
        """One gradient step on a random batch.

        Raises:
            WorkError: If loss or gradient is not finite; the network is as before.
        """
        loss = self._loss()
        if not torch.isfinite(loss):
            raise WorkError(f"the loss of step {self.num_steps} is {loss.item()}.")
        self._optimizer.zero_grad()
        loss.backward()
        # The gradient of a finite loss may overflow.
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        if not all(gradient.isfinite().all() for gradient in gradients):
            raise WorkError(f"the gradient of step {self.num_steps} is not finite.")
        self._optimizer.step()
        self._schedule.step()
        self.num_steps += 1
        weight = max(1 / self.num_steps, 0.001)
        self.mean_loss += weight * (loss.item() - self.mean_loss)

    def save(self, path: Path, origin: dict[str, Any]) -> None:
        """Writes a checkpoint: going on from it is as if never stopped.

        Args:
            path: The file.
            origin: What else the work depends on: seed, data, first weights.
        """
        buffer = io.BytesIO()
        torch.save(
            {
                **{name: m.state_dict() for name, m in self._modules().items()},
                "optimizer": self._optimizer.state_dict(),
                "schedule": self._schedule.state_dict(),
                "generator": json.dumps(self._generator.bit_generator.state),
                "num_steps": self.num_steps,
                "mean_loss": self.mean_loss,
                "architecture": self.network.architecture,
                "config": vars(self.config),
                "origin": json.dumps(origin),
            },
            buffer,
        )
        write_atomically(path, buffer.getvalue())

    def resume(self, path: Path, origin: dict[str, Any]) -> None:
        """Goes on from a checkpoint of `save`.

        Raises:
            InputError: If it cannot be read, or belongs to other work.
        """
        try:
            saved = torch.load(
                path, weights_only=True, map_location=self.network.device
            )
            same = (
                saved["architecture"] == self.network.architecture
                and saved["config"] == vars(self.config)
                and saved["origin"] == json.dumps(origin)
            )
            if not same:
                raise InputError(
                    f"{path}: a checkpoint of other work; delete it to start anew."
                )
            for name, module in self._modules().items():
                module.load_state_dict(saved[name])
            self._optimizer.load_state_dict(saved["optimizer"])
            self._schedule.load_state_dict(saved["schedule"])
            self._generator.bit_generator.state = json.loads(saved["generator"])
            self.num_steps, self.mean_loss = saved["num_steps"], saved["mean_loss"]
        except (
            OSError,
            EOFError,
            RuntimeError,
            KeyError,
            ValueError,
            pickle.UnpicklingError,
        ) as error:
            raise InputError(f"{path}: not a readable checkpoint ({error}).") from error
