"""Options of several commands."""

from typing import Annotated

import typer

# As far as all that is seeded can count.
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Of all random draws.")]
NumWorkers = Annotated[int, typer.Option(min=1, help="Processes on this machine.")]
RayAddress = Annotated[
    str | None,
    typer.Option(
        help='Work on the Ray cluster at this address instead; "auto" for the one '
        "that this machine is part of."
    ),
]
