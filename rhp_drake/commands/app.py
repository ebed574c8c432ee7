"""The command `rhp` with its subcommands, one a module of this folder."""

import typer

from rhp_drake.commands.bench import bench
from rhp_drake.commands.calibrate import calibrate
from rhp_drake.commands.demos import demos
from rhp_drake.commands.driver import driver
from rhp_drake.commands.evaluate import evaluate
from rhp_drake.commands.figure4 import figure4
from rhp_drake.commands.lab import lab
from rhp_drake.commands.learn import imitate, reinforce
from rhp_drake.commands.plan import plan
from rhp_drake.commands.report import report
from rhp_drake.commands.run import run

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    # A traceback is for developers; it need not fill the screen with variables.
    pretty_exceptions_show_locals=False,
)
for command in (
    run,
    lab,
    driver,
    calibrate,
    plan,
    imitate,
    reinforce,
    evaluate,
    report,
    figure4,
):
    app.command()(command)
app.add_typer(demos, name="demos")
app.add_typer(bench, name="bench")


@app.callback()
def rhp() -> None:
    """Receding-horizon planning with a learned value function, in Drake."""
