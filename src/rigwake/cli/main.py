"""`rigwake VERB ...`: one module per verb beside this one; only here does an error become an exit code.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 the motion cannot determine what was asked.
"""

from __future__ import annotations

import importlib
import sys

import typer

from rigwake import __version__
from rigwake.cli.console import print_error
from rigwake.errors import RigwakeError

# one module per verb in this package, each with a function `command`; the order is that of --help
VERBS: tuple[str, ...] = (
    "calibrate",
    "inspect",
    "odometry",
    "handeye",
    "intrinsics",
    "undistort",
    "evaluate",
    "diff",
    "export",
    "report",
    "simulate",
    "demo",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rigwake {__version__}")
        raise typer.Exit


def _root(
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """Calibrate a camera rig from the wake it leaves."""


def build_app() -> typer.Typer:
    """The command-line application with every verb."""
    app = typer.Typer(
        name="rigwake", no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False
    )
    app.callback()(_root)
    for verb in VERBS:
        module = importlib.import_module(f"rigwake.cli.{verb}")
        app.command(verb)(module.command)
    return app


def main() -> None:
    """Entry point of the `rigwake` program."""
    try:
        build_app()()
    except RigwakeError as error:
        print_error(error)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        sys.exit(1)
