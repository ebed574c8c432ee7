"""RHP-guided reinforcement learning (section V of the paper), in rounds.

In a round epsilon-RHP acts on fresh training tasks with the network as it is, and then
the network learns from all rounds and the demonstrations.  So acting can be spread over
processes, and a round's experience is a folder of demonstrations like any other: work
that is stopped goes on where it was, with the same result.

The paper's replay buffer holds what was executed, and loses an old transition for each
new one.  So it is here, too, if only executed transitions are kept; else demonstrations
and experience have equal shares of each batch, and nothing is lost.
"""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
import shutil
from typing import Final

from rhp_drake.errors import InputError
from rhp_drake.learning.dataset import (
    Dataset,
    concatenate,
    load_dataset,
    without_oldest,
)
from rhp_drake.learning.demonstration_folder import demonstrate_tasks
from rhp_drake.learning.demonstrators import Acting, RecedingHorizonDemonstrator
from rhp_drake.learning.fitted_q import FittedQ
from rhp_drake.workers import Workers

# Far from the tasks that demonstrations are made of.
_FIRST_TASK: Final = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """How acting and learning alternate.

    Attributes:
        num_tasks: On which RHP acts in a round.
        num_steps: Gradient steps of a round.
        acting: How RHP acts.
    """

    num_tasks: int = 100
    num_steps: int = 1000
    acting: Acting = Acting()


class Reinforcement:
    """Feeds a learner with the experience that its own network makes.

    Args:
        learner: With the demonstrations as its source, or without any.
        rounds: How.
        folder: Of the experience, a folder a round.
        seed: Of tasks and policy.
        workers: Who acts.
        commit: Of the code, to be noted with the experience.

    Attributes:
        rounds: How.

    Raises:
        InputError: If the steps of a learner are no whole number of rounds.
    """

    def __init__(
        self,
        learner: FittedQ,
        rounds: Rounds,
        folder: Path,
        seed: int,
        workers: Workers,
        commit: str,
    ) -> None:
        if learner.config.num_steps % rounds.num_steps:
            raise InputError(
                f"{learner.config.num_steps} steps are no whole number of rounds of "
                f"{rounds.num_steps}."
            )
        self._learner = learner
        self.rounds = rounds
        self._folder = folder
        self._seed = seed
        self._workers = workers
        self._commit = commit
        self._demonstrations = list(learner.sources)
        self._experience: list[Dataset] = []

    @property
    def num_transitions(self) -> int:
        """How many transitions of its experience have been learned from so far."""
        self._read(-(-self._learner.num_steps // self.rounds.num_steps))
        return sum(len(data.search_actions) for data in self._experience)

    def act(self) -> Iterator[int]:
        """Makes, or reads, the experience that the learner's next step needs.

        Yields:
            The number of tasks done in this round, if there is anything to do.
        """
        index, steps = divmod(self._learner.num_steps, self.rounds.num_steps)
        if self._learner.num_steps == 0:
            # There is no checkpoint: later rounds are of work that began otherwise.
            for path in set(self._folder.glob("round_*")) - {self._round(0)}:
                shutil.rmtree(path)
        if steps == 0:
            yield from self._act(index)
        if self._read(index + 1):
            self._learner.sources = self._replay_buffer()

    def forget(self) -> None:
        """Removes the experience, once nothing is to be learned from it any more."""
        shutil.rmtree(self._folder)

    def _read(self, num_rounds: int) -> bool:
        """Reads the experience of the first so many rounds; whether any was new."""
        new = range(len(self._experience), num_rounds)
        self._experience += [load_dataset([self._round(index)]) for index in new]
        return len(new) > 0

    def _replay_buffer(self) -> list[Dataset]:
        experience = concatenate(self._experience)
        if not self.rounds.acting.executed_only:
            return [*self._demonstrations, experience]
        both = concatenate([*self._demonstrations, experience])
        return [without_oldest(both, len(experience.search_actions))]

    def _round(self, index: int) -> Path:
        return self._folder / f"round_{index:04d}"

    def _act(self, index: int) -> Iterator[int]:
        first = _FIRST_TASK + index * self.rounds.num_tasks
        demonstrator = RecedingHorizonDemonstrator(
            self._seed,
            # The network goes on learning; physics need the processor, not the GPU.
            deepcopy(self._learner.network).cpu(),
            self.rounds.acting,
            self._demonstrations[0] if self.rounds.acting.resets else None,
        )
        yield from demonstrate_tasks(
            self._round(index),
            range(first, first + self.rounds.num_tasks),
            demonstrator,
            self._workers,
            self._commit,
        )
