"""`rhp imitate` and `rhp fit`: from demonstrations to a Q-network."""

import hashlib
from pathlib import Path
import sys
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rhp_drake.errors import InputError

_VALIDATION_TASKS: Final = 200

# torch and Drake are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rhp_drake.value.q_network import QNetwork

_Demos = Annotated[
    list[Path],
    typer.Option(help="File or folder of demonstrations; may be repeated."),
]
_Out = Annotated[Path, typer.Option(help="File of the trained weights.")]
_Seed = Annotated[int, typer.Option(min=0, help="Of all random draws.")]


def imitate(
    *,
    demonstrations: _Demos,
    out: _Out,
    seed: _Seed = 0,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the plans.")] = 150,
) -> None:
    """Trains a Q-network on the plans alone, by the paper's Eq. 2 and 3."""
    from rich.console import Console
    import torch

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.files import check_writable
    from rhp_drake.learning.demonstrations import load_demonstrations
    from rhp_drake.learning.imitation import ImitationConfig, imitate
    from rhp_drake.random_streams import stream
    from rhp_drake.value.q_network import QNetwork

    torch.set_flush_denormal(True)
    check_writable(out)
    console = Console()
    data = load_demonstrations(demonstrations)
    if not data.solved.any():
        raise InputError("none of the demonstrations holds a plan to imitate.")
    config = ImitationConfig(num_epochs=epochs)
    torch.manual_seed(seed)
    network = QNetwork(data.goals.shape[1])
    loss = float("nan")
    with make_progress(console) as progress:
        bar = progress.add_task("Epochs", total=epochs)
        for loss in imitate(network, data, config, stream(seed, "imitation")):
            progress.update(bar, advance=1, description=f"loss {loss:.2f}")
    _save(
        network, out, demonstrations, data, seed, vars(config) | {"loss": loss}, console
    )


def fit(
    *,
    demonstrations: _Demos,
    start: Annotated[Path, typer.Option(help="Weights to start from.")],
    out: _Out,
    seed: _Seed = 0,
    steps: Annotated[int, typer.Option(min=1, help="Gradient steps.")] = 40_000,
) -> None:
    """Improves a Q-network by double Q-learning on all that the searches simulated.

    Stopped at any moment, the same command goes on from its last checkpoint, a file
    beside the weights.
    """
    from rich.console import Console
    import torch

    from rhp_drake.commands.progress import make_progress
    from rhp_drake.files import check_writable
    from rhp_drake.learning.demonstration_folder import describe
    from rhp_drake.learning.demonstrations import load_demonstrations
    from rhp_drake.learning.fitted_q import FittedQ, FittedQConfig
    from rhp_drake.random_streams import stream
    from rhp_drake.value.q_network import load_q_network

    check_writable(out)
    # Gradients of dead units get so small that arithmetic takes five times as long.
    torch.set_flush_denormal(True)
    console = Console()
    data = load_demonstrations(demonstrations)
    network = load_q_network(start, data.goals.shape[1])
    config = FittedQConfig(num_steps=steps)
    learner = FittedQ(network, data, config, stream(seed, "fitted_q"))
    origin = {
        "seed": seed,
        "start": hashlib.sha256(start.read_bytes()).hexdigest(),
        "demonstrations": [describe(path) for path in demonstrations],
        "transitions": len(data.search_actions),
    }
    checkpoint = out.with_name(out.name + ".checkpoint")
    if checkpoint.exists():
        learner.resume(checkpoint, origin)
        console.print(f"Goes on from step {learner.num_steps} of {checkpoint}.")
    with make_progress(console) as progress:
        bar = progress.add_task("Steps", total=steps, completed=learner.num_steps)
        while learner.num_steps < steps:
            learner.step()
            if learner.num_steps % 100 == 0:
                progress.update(
                    bar,
                    completed=learner.num_steps,
                    description=f"loss {learner.mean_loss:.3f}",
                )
            if learner.num_steps % 1000 == 0:
                learner.save(checkpoint, origin)
    details = vars(config) | {"loss": learner.mean_loss}
    details["start"] = network.provenance
    _save(network, out, demonstrations, data, seed, details, console)
    checkpoint.unlink(missing_ok=True)


def _save(
    network: "QNetwork",
    path: Path,
    sources: list[Path],
    data: Any,
    seed: int,
    details: dict[str, Any],
    console: Any,
) -> None:
    """Writes the weights with where they come from."""
    from rhp_drake.learning.demonstration_folder import describe
    from rhp_drake.run_record import source_commit

    successes, trials = _greedy_successes(network)
    network.provenance = {
        "command": " ".join(["rhp", *sys.argv[1:]]),
        "commit": source_commit(),
        "seed": seed,
        "demonstrations": [describe(path) for path in sources],
        "plans": len(data.goals),
        "plans_solved": int(data.solved.sum()),
        "transitions": len(data.search_actions),
        "validation_successes_of_gp": f"{successes} of {trials}",
        **details,
    }
    network.save(path)
    console.print(
        f"{path}: {path.stat().st_size / 1e3:.0f} kB, greedily solves {successes} of "
        f"{trials} validation tasks."
    )


def _greedy_successes(network: "QNetwork") -> tuple[int, int]:
    """How many of some validation tasks the greedy policy solves, and of how many.

    There are frozen tasks for three objects only.
    """
    from rhp_drake.evaluation.episode import run_episode
    from rhp_drake.frozen_instances import load_instances
    from rhp_drake.planning.receding_horizon import RecedingHorizon
    from rhp_drake.push_model.transition import PushModel
    from rhp_drake.random_streams import VALIDATION

    instances = load_instances(VALIDATION)[:_VALIDATION_TASKS]
    if network.num_objects != instances[0].num_objects:
        return 0, 0
    world = PushModel(network.num_objects)
    policy = RecedingHorizon(world, network, 0, 0, 1.0)
    episodes = [
        run_episode(world, policy, instance, 0, index)
        for index, instance in enumerate(instances)
    ]
    return sum(episode.succeeded for episode in episodes), len(instances)
