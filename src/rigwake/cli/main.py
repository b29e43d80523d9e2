"""`rigwake VERB ...`: one module per verb beside this one; only here does an error become an exit code.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 the motion cannot determine what was asked, 4 a result without all
cameras, 5 a camera has moved (`monitor`); 130 and 143 after Ctrl-C and SIGTERM.

Verbs import what computes only when they run, so that --help and the completion of the shell are quick.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import ModuleType

import typer
from typer.completion import get_completion_inspect_parameters

from rigwake import __version__
from rigwake.cli.console import adapt_streams, err, print_error
from rigwake.cli.faults import Stopped, signals_raise, silence_output, words_of
from rigwake.kernel_cache import provide_kernel_cache

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
    "monitor",
    "recalibrate",
    "log",
    "report",
    "convert",
    "surround",
    "segment",
    "stixels",
    "depth",
    "simulate",
    "demo",
)

# one module per group of verbs, each with `COMMANDS`: verb -> function
GROUPS: tuple[str, ...] = ("fleet", "ros")

EXIT_CODES = (
    "Exit codes: 0 done; 1 failed; 2 wrong usage; 3 the motion cannot determine it; 4 done, but a camera is missing "
    "from the result; 5 a camera has moved (monitor)."
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


def build_app(
    verbs: Sequence[str] = (*VERBS, *GROUPS), *, outline: bool = False, options: bool = True
) -> typer.Typer:
    """The command-line application with these verbs and groups of verbs.

    outline: their names and what they do, without their options: what a list of verbs takes, and much quicker.
    options: with those before the verb, such as --help. Where the shell completes a verb they only take time.
    """
    app = typer.Typer(
        name="rigwake",
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"] if options else []},
        epilog=EXIT_CODES,
        add_completion=options,
    )
    app.callback()(_root)
    for verb in verbs:
        module = importlib.import_module(f"rigwake.cli.{verb}")
        if verb in GROUPS:
            app.add_typer(_group(module.COMMANDS, module.__doc__ or ""), name=verb)
        else:
            epilog = "\n\n".join(filter(None, [getattr(module, "HELP", ""), EXIT_CODES]))
            app.command(verb, epilog=epilog)(_outlined(module.command) if outline else module.command)
    return app


def _outlined(command: Callable[..., None]) -> Callable[[], None]:
    def without_options() -> None: ...

    without_options.__doc__ = command.__doc__
    return without_options


def _group(commands: Mapping[str, Callable[..., None]], help_text: str) -> typer.Typer:
    """Verbs of two words, such as `fleet calibrate`."""
    group = typer.Typer(
        no_args_is_help=True,
        help=help_text,
        epilog=EXIT_CODES,
        context_settings={"help_option_names": ["--help", "-h"]},
    )
    for name, command in commands.items():
        group.command(name, epilog=EXIT_CODES)(command)
    return group


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `rigwake` program; ends with SystemExit. arguments: by default those of the process."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    adapt_streams()
    with signals_raise(words):
        sys.exit(_exit_code(words))


def _exit_code(words: list[str]) -> int:
    """Run the command; whatever goes wrong is printed and becomes a code."""
    try:
        code = _run(words)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except Stopped as stopped:
        error, code = stopped.words(words), stopped.exit_code
    except BrokenPipeError:  # as with `| head`
        silence_output()
        return 1
    except Exception as fault:
        error = words_of(fault)
        code = error.exit_code
        if isinstance(fault, OSError):
            silence_output()
    with contextlib.suppress(OSError):
        print_error(error)
    return code


def _run(words: list[str]) -> int:
    try:
        _say_where_kernels_are(words)
        known = (*VERBS, *GROUPS)
        line = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS") or ""  # by which shell
        is_completing = "_RIGWAKE_COMPLETE" in os.environ
        typed = line.split()[1:] if is_completing else words
        if typed and typed[0] in known:
            app = build_app(typed[:1])  # the others need not be imported
        else:
            is_option = bool(typed) and typed[0].startswith("-")
            app = build_app(outline=True, options=is_option or not is_completing)
        if is_completing:
            get_completion_inspect_parameters()  # brings the shells' forms, else brought by options
        with _no_conversion() if is_completing else contextlib.nullcontext():
            app(words, prog_name="rigwake")
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(bool(ended.code))
    return 0


@contextlib.contextmanager
def _no_conversion() -> Iterator[None]:
    """Keep typer from loading what converts the values of options: completion needs none, and it takes half of its
    time. Another typer, which has no such module, does not notice."""
    converters = ModuleType("typer._adapters")
    converters.try_build_adapter = lambda *_, **__: None  # type: ignore[attr-defined]
    is_loaded = converters.__name__ in sys.modules
    sys.modules.setdefault(converters.__name__, converters)
    try:
        yield
    finally:
        if not is_loaded:
            del sys.modules[converters.__name__]


def _say_where_kernels_are(words: list[str]) -> None:
    """Say once that compiled loops are kept among the temporary files."""
    folder = provide_kernel_cache()
    if folder is not None and words[:1] and words[0] in (*VERBS, *GROUPS) and not any(folder.iterdir()):
        err.print(
            f"note: neither the installation nor a home folder can be written; compiled loops are kept in {folder} "
            "(choose another place with NUMBA_CACHE_DIR)",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )
