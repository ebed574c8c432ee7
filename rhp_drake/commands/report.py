"""`rhp report`: what a folder of results comes to."""

import logging
from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[Path, typer.Argument(help="Where `rhp evaluate --out` worked.")],
    *,
    recordings: Annotated[
        int,
        typer.Option(
            min=0, help="Record so many failures of the most successful policies."
        ),
    ] = 4,
) -> None:
    """Writes tables, tests, pictures and recordings of results, as a page.

    Writes report.md, report.html, which holds its pictures, and recordings of
    failures. With the results of `rhp figure4` in the folder's figure4, these, too.
    """
    from rich.console import Console

    from rhp_drake.evaluation.report import write_report

    # Where Meshcat listens is nothing to a recording.
    logging.getLogger("drake").setLevel(logging.WARNING)
    written = write_report(folder, recordings)
    Console(highlight=False, soft_wrap=True).print(
        f"{written.page} (open it in a browser), {written.markdown}"
    )
