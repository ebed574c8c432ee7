"""`rhp imitate` and `rhp reinforce`: from demonstrations to a Q-network."""

from dataclasses import asdict, replace
import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rhp_drake.commands.options import Seed
from rhp_drake.commands.training import train_and_save
from rhp_drake.errors import InputError
from rhp_drake.files import check_writable

# torch and Drake are imported in the functions, so that `rhp --help` is quick.
if TYPE_CHECKING:
    from rhp_drake.value.q_network import QNetwork

_Demos = Annotated[
    list[Path],
    typer.Option(help="File or folder of demonstrations; may be repeated."),
]
_Out = Annotated[Path, typer.Option(help="File of the trained weights.")]
_Start = Annotated[Path, typer.Option(help="Weights to start from.")]
_Steps = Annotated[int, typer.Option(min=1, help="Gradient steps.")]


def imitate(
    *,
    demonstrations: _Demos,
    out: _Out,
    seed: Seed = 0,
    steps: _Steps = 40_000,
    network: Annotated[
        str, typer.Option(help="set, or paper: the layers of the paper.")
    ] = "set",
) -> None:
    """Trains a Q-network on the plans alone, by the paper's Eq. 2 and 3.

    You may stop this at any moment: the same command goes on from its last checkpoint,
    a file beside the weights.
    """
    from rich.console import Console

    from rhp_drake.learning.dataset import load_dataset
    from rhp_drake.learning.imitation import Imitation, ImitationConfig
    from rhp_drake.learning.training import make_repeatable
    from rhp_drake.random_streams import stream
    from rhp_drake.value.q_network import ARCHITECTURES

    if network not in ARCHITECTURES:
        known = ", ".join(ARCHITECTURES)
        raise InputError(f"--network: {network!r} is not one of {known}.")
    check_writable(out)
    device = make_repeatable(seed)
    data = load_dataset(demonstrations)
    if not data.solved.any():
        raise InputError("none of the demonstrations holds a plan to imitate.")
    untrained = ARCHITECTURES[network](data.goals.shape[1]).to(device)
    config = ImitationConfig(num_steps=steps)
    learner = Imitation(untrained, data, config, stream(seed, "imitation"))
    train_and_save(learner, out, demonstrations, {"seed": seed}, Console())


def reinforce(
    *,
    demonstrations: _Demos,
    start: _Start,
    out: _Out,
    seed: Seed = 0,
    steps: _Steps = 40_000,
    variant: Annotated[
        str, typer.Option(help="best, or paper: as the paper does it.")
    ] = "best",
    workers: Annotated[
        int, typer.Option(min=1, help="How many processes act on this machine.")
    ] = 2,
) -> None:
    """Improves a Q-network by RHP-guided reinforcement learning (section V).

    You may stop this at any moment: the same command goes on where it was, from files
    beside the weights.
    """
    from rich.console import Console

    from rhp_drake.learning.dataset import load_dataset
    from rhp_drake.learning.fitted_q import FittedQ
    from rhp_drake.learning.reinforcement import Reinforcement
    from rhp_drake.learning.training import make_repeatable
    from rhp_drake.learning.variants import VARIANTS
    from rhp_drake.random_streams import stream
    from rhp_drake.run_record import source_commit
    from rhp_drake.value.weights import load_q_network

    # Those that leave something out are for `rhp bench reinforcement`.
    if variant not in ("best", "paper"):
        raise InputError(f"--variant: {variant!r} is neither best nor paper.")
    check_writable(out)
    device = make_repeatable(seed)
    data = load_dataset(demonstrations)
    if not len(data.search_actions):
        raise InputError("none of the demonstrations holds a search to learn from.")
    network = load_q_network(start, data.goals.shape[1]).to(device)
    chosen = VARIANTS[variant]
    if network.architecture != chosen.network:
        raise InputError(
            f"{start}: the weights of the network {network.architecture!r}; the "
            f"variant {variant} has the network {chosen.network!r}."
        )
    if chosen.plans_only and len(data.search_actions) != len(data.plan_actions):
        raise InputError(
            f"the variant {variant} learns from plans alone, as `rhp demos rebuild` "
            "makes them; the demonstrations hold other transitions, too."
        )
    config = replace(chosen.learning, num_steps=steps)
    learner = FittedQ(network, [data], config, stream(seed, "reinforcement"))
    reinforcement = Reinforcement(
        learner,
        chosen.rounds,
        out.with_name(out.name + ".rounds"),
        seed,
        workers,
        source_commit(),
    )
    origin = _origin(seed, start, network) | {"rounds": asdict(chosen.rounds)}
    train_and_save(learner, out, demonstrations, origin, Console(), reinforcement)


def _origin(seed: int, start: Path, network: "QNetwork") -> dict[str, Any]:
    """What a result depends on beside data and settings."""
    return {
        "seed": seed,
        "start": hashlib.sha256(start.read_bytes()).hexdigest(),
        "start_provenance": network.provenance,
    }
