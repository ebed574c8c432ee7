"""`rhp bench reinforcement`: what each part of the learning method is worth."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rhp_drake.commands.options import NumWorkers
from rhp_drake.errors import InputError

# torch, Drake and matplotlib are imported in the functions, so that `rhp --help` is
# quick.
if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from rhp_drake.benchmarks.reinforcement import TrainingResult

_VARIANTS = (
    "best,from_scratch,executed_only,no_hindsight,paper_network,no_symmetry,"
    "plans_only,no_double_q,epsilon_greedy,uncertain_physics,paper"
)


def reinforcement(
    *,
    out: Annotated[
        Path, typer.Option(help="Folder of weights, learning curves and pictures.")
    ],
    variants: Annotated[str, typer.Option(help="Any of the default ones.")] = _VARIANTS,
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each.")] = 3,
    steps: Annotated[
        int, typer.Option(min=1000, help="Gradient steps of a training.")
    ] = 8000,
    workers: NumWorkers = 2,
) -> None:
    """Trains variants of the method, and compares them on validation tasks.

    They start from the shipped imitation weights, and all have the demonstrations of
    1000 tasks; from_scratch has neither. You may stop this at any moment: the same
    command goes on where it was.
    """
    from rich.console import Console

    from rhp_drake.benchmarks.reinforcement import Training, Trainings
    from rhp_drake.commands.progress import make_progress
    from rhp_drake.evaluation.machine import describe_machine
    from rhp_drake.evaluation.plots import draw_learning_curves, save_picture
    from rhp_drake.learning.variants import VARIANTS
    from rhp_drake.run_record import source_commit

    names = list(dict.fromkeys(variants.split(",")))
    for name in names:
        if name not in VARIANTS:
            raise InputError(
                f"--variants: {name!r} is not one of {', '.join(VARIANTS)}."
            )
        num_steps = VARIANTS[name].rounds.num_steps
        if steps % num_steps:
            raise InputError(
                f"--steps: {steps} steps are no whole number of rounds of {num_steps}."
            )
    wanted = [Training(name, seed) for seed in range(seeds) for name in names]
    console = Console(highlight=False, soft_wrap=True)
    results: list[TrainingResult] = []
    try:
        with make_progress(console) as progress:
            bar = progress.add_task("Trainings", total=len(wanted))
            work = Trainings(out, steps, source_commit())
            for result in work.make(wanted, workers):
                results.append(result)
                progress.advance(bar)
    except KeyboardInterrupt:
        console.print("Stopped; the same command goes on from here.")
        raise typer.Exit(130) from None
    # Sorted: the order in which workers finish means nothing.
    by_variant = {
        name: sorted(
            (r for r in results if r.training.variant == name),
            key=lambda result: result.training.seed,
        )
        for name in names
    }
    curves = {
        name: [
            ([step for step, _ in r.curve], [n / len(r.greedy) for _, n in r.curve])
            for r in of_variant
        ]
        for name, of_variant in by_variant.items()
    }
    save_picture(draw_learning_curves(curves), out / "learning_curves")
    console.print(_table(by_variant, steps))
    console.print(f"{out}: learning_curves.svg, learning_curves.png, weights")
    console.print(describe_machine(workers))


def _table(by_variant: "dict[str, list[TrainingResult]]", steps: int) -> "Table":
    """Success of all seeds together, and of each."""
    import numpy as np
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from rhp_drake.evaluation.statistics import format_grouped_rate

    def cells(of_seeds: "Sequence[Sequence[bool]]") -> list[str]:
        succeeded = np.array(of_seeds)
        return [
            format_grouped_rate(succeeded),
            ", ".join(f"{100 * rate:.1f}" for rate in succeeded.mean(axis=1)),
        ]

    table = Table(
        title=f"After {steps} steps, % of validation tasks (95 % Wilson)",
        box=SIMPLE_HEAD,
        title_justify="left",
        # So it fits into 80 columns.
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    table.add_column("variant", no_wrap=True)
    for heading in ("GP", "by seed", "RHP-33", "by seed", "transitions"):
        table.add_column(heading, justify="right")
    for name, results in by_variant.items():
        transitions = sum(r.num_transitions for r in results) / len(results)
        table.add_row(
            name,
            *cells([r.greedy for r in results]),
            *cells([r.rhp33 for r in results]),
            f"{transitions:.0f}",
        )
    return table
