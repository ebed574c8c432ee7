"""What the commands that train a Q-network share: progress, logs, the weights' file."""

from dataclasses import asdict
import json
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Any, Final

import typer

from rhp_drake.errors import InputError, WorkError

# torch and Drake are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rich.console import Console

    from rhp_drake.learning.learner import Learner
    from rhp_drake.learning.reinforcement import Reinforcement

_LOG_PERIOD: Final = 100
_VALIDATION_PERIOD: Final = 4000


def train_and_save(
    learner: "Learner",
    out: Path,
    sources: list[Path],
    origin: dict[str, Any],
    console: "Console",
    reinforcement: "Reinforcement | None" = None,
) -> None:
    """Trains to the end, from a checkpoint if there is one, and writes the weights.

    Progress is shown, and logged for TensorBoard in a folder beside the weights.  So is
    the greedy policy's success on validation tasks, every now and then.  If the weights
    are there, it says so.

    Args:
        learner: Trains the network.
        out: File of the weights.
        sources: Where the data come from.
        origin: What else the result depends on, for checkpoint and provenance.
        console: Where to say things.
        reinforcement: Makes experience on the way, which is removed at the end.

    Raises:
        typer.Exit: With status 130 after Ctrl-C.
        InputError: If the weights' file is there and holds something else.
        WorkError: If the loss is not finite, a worker dies, or nothing can be written;
            the last checkpoint stays.
    """
    from rhp_drake.learning.demonstration_folder import describe
    from rhp_drake.run_record import source_commit
    from rhp_drake.value.weights import save_q_network

    # Before the work: it may be long, and the code may change meanwhile.
    commit = source_commit()
    origin |= {"demonstrations": [describe(path) for path in sources]}
    checkpoint = out.with_name(out.name + ".checkpoint")
    if out.exists() and not checkpoint.exists():
        _check_done(out, learner, origin)
        console.print(f"{out}: is there already.")
        return
    try:
        solved = _train(learner, out, checkpoint, origin, console, reinforcement)
    except KeyboardInterrupt:
        console.print("Stopped; the same command goes on from its last checkpoint.")
        raise typer.Exit(130) from None
    except OSError as error:
        # Of TensorBoard; our own files have sentences of their own.
        raise WorkError(
            f"{error.filename or out}: cannot be written: {error.strerror}."
        ) from error
    except WorkError as error:
        if not checkpoint.exists():
            raise
        raise WorkError(f"{error}  The last checkpoint is {checkpoint}.") from error
    network = learner.network
    network.provenance = {
        "command": " ".join(["rhp", *sys.argv[1:]]),
        "commit": commit,
        **origin,
        "validation_successes_of_gp": f"{sum(solved)} of {len(solved)}",
        **asdict(learner.config),  # type: ignore[call-overload]
        "loss": learner.mean_loss,
    }
    save_q_network(network, out)
    if reinforcement is not None:
        reinforcement.forget()
    # Last, because without it the work would be taken for done.
    checkpoint.unlink(missing_ok=True)
    console.print(
        f"{out}: {out.stat().st_size / 1e3:.0f} kB, greedily solves {sum(solved)} of "
        f"{len(solved)} validation tasks."
    )


def _check_done(out: Path, learner: "Learner", origin: dict[str, Any]) -> None:
    """Raises an InputError if the file is not what this training makes."""
    from rhp_drake.value.weights import load_q_network

    noted = load_q_network(out, learner.network.num_objects).provenance
    made = {**origin, **asdict(learner.config)}  # type: ignore[call-overload]
    # As JSON, in which the file has it.
    wanted = json.loads(json.dumps(made))
    if {name: noted.get(name) for name in wanted} != wanted:
        raise InputError(f"{out}: holds weights of other work; choose another file.")


def _train(
    learner: "Learner",
    out: Path,
    checkpoint: Path,
    origin: dict[str, Any],
    console: "Console",
    reinforcement: "Reinforcement | None",
) -> list[bool]:
    """Trains; returns whether each validation task is solved greedily then."""
    from torch.utils.tensorboard import SummaryWriter

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.validation import greedy_successes
    from rhp_drake.learning.training import Acted, train

    steps = train(learner, checkpoint, origin, reinforcement)
    total = learner.config.num_steps
    logs = out.with_name(out.name + ".logs")
    with (
        # What a stopped training logged after its checkpoint comes again.
        SummaryWriter(str(logs), purge_step=learner.num_steps + 1) as writer,
        make_progress(console) as progress,
    ):
        if learner.num_steps:
            console.print(f"Goes on from step {learner.num_steps} of {checkpoint}.")
        bar = progress.add_task("Steps", total=total, completed=learner.num_steps)
        acting = progress.add_task("Tasks", visible=False)
        for event in steps:
            if isinstance(event, Acted):
                tasks = reinforcement.rounds.num_tasks if reinforcement else None
                progress.update(
                    acting, completed=event.num_tasks, total=tasks, visible=True
                )
                continue
            step = event.num_steps
            if step % _LOG_PERIOD == 0:
                loss = learner.mean_loss
                progress.update(bar, completed=step, description=f"loss {loss:.3f}")
                writer.add_scalar("loss", loss, step)
            if step % _VALIDATION_PERIOD == 0 and step < total:
                solved = greedy_successes(learner.network)
                writer.add_scalar("greedy success", sum(solved) / len(solved), step)
        solved = greedy_successes(learner.network)
        writer.add_scalar("greedy success", sum(solved) / len(solved), total)
    return solved
