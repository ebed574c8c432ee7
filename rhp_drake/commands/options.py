"""Options of several commands: who does the work."""

from typing import Annotated

import typer

NumWorkers = Annotated[int, typer.Option(min=1, help="Processes on this machine.")]
RayAddress = Annotated[
    str | None,
    typer.Option(
        help='Work on the Ray cluster at this address instead; "auto" for the one '
        "that this machine is part of."
    ),
]
