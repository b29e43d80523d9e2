"""Many recordings: each once, on this machine or a cluster, and a table of all.

Example: [cyan]rigwake fleet calibrate 'boats/*/*.bag' --out OUT[/cyan]
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from rich.markup import escape

from rigwake.cli.console import out, progress_bar, write_json
from rigwake.cli.options import (
    AllowPartialOption,
    JsonOption,
    SettingOption,
    TopicOption,
    TopicsOption,
    require_number,
    require_scheduler,
    require_there,
    require_writable,
)
from rigwake.errors import EstimationError, PartialResultError, UsageError

if TYPE_CHECKING:
    from rigwake.fleet.fleet_run import FleetPlan, FleetResult
    from rigwake.fleet.recording_list import ListedRecording

_GIB = 2**30


@dataclass(frozen=True)
class FleetChoices:
    """What every verb over a fleet lets one choose. Each field is an option (or argument) of the command line."""

    recordings: Annotated[
        list[str],
        typer.Argument(
            help="Recordings, folders, patterns in quotes, or a text file: PATH[,VESSEL] per line."
        ),
    ]
    out_folder: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for results and tables, shared by all machines.")
    ]
    scheduler: Annotated[
        str, typer.Option(help="Dask cluster: tcp://HOST:PORT, or local:N workers (extra `fleet`).")
    ] = ""
    jobs: Annotated[int, typer.Option(min=0, help="Processes on this machine (0: one per core).")] = 0
    timeout: Annotated[float, typer.Option(help="Seconds after which a recording is given up.")] = 3600.0
    memory: Annotated[float | None, typer.Option(help="GiB that one recording may take (default: any).")] = (
        None
    )
    retries: Annotated[
        int, typer.Option(min=0, max=10, help="How often a recording whose worker was lost is tried again.")
    ] = 1
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Only the I-th of N parts, for job arrays: 1/8 .. 8/8.")
    ] = None
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Try again what failed in a former run.")
    ] = False
    vessel: Annotated[
        str, typer.Option(help="Whose recordings they are (default: by the list, else by the folder's name).")
    ] = ""
    topic: TopicOption = None
    topics: TopicsOption = None
    allow_partial: AllowPartialOption = False
    json_file: JsonOption = None


def _with_fleet_choices(verb: Callable[..., None]) -> Callable[..., None]:
    """A command with the options of `verb` and those of `FleetChoices`, which `verb` takes as its first argument."""
    shared = get_type_hints(FleetChoices, include_extras=True)
    own = get_type_hints(verb, include_extras=True)
    given = [*signature(FleetChoices).parameters.values(), *list(signature(verb).parameters.values())[1:]]
    hints = {**shared, **{name: hint for name, hint in own.items() if name not in ("choices", "return")}}

    @wraps(verb)
    def command(**values: Any) -> None:
        mine = {name: values.pop(name) for name in list(values) if name not in shared}
        verb(FleetChoices(**values), **mine)

    keyword = Parameter.KEYWORD_ONLY
    command.__signature__ = Signature(  # type: ignore[attr-defined]
        [p.replace(kind=keyword, annotation=hints[p.name]) for p in given]
    )
    command.__annotations__ = hints
    return command


@_with_fleet_choices
def calibrate(
    choices: FleetChoices,
    config: Annotated[Path | None, typer.Option(help="YAML file of settings, as for `calibrate`.")] = None,
    assignments: SettingOption = None,
) -> None:
    """Calibrate many recordings, each once. A second run does only what is new or changed.

    Example: [cyan]rigwake fleet calibrate 'boats/*/*.bag' --out OUT[/cyan]

    Example: [cyan]rigwake fleet calibrate list.csv --out /shared/OUT --scheduler tcp://head:8786[/cyan]
    """
    require_there(config, choices.topics)
    plan = _plan(choices)
    from rigwake.config import load_config

    settings = load_config(config, assignments or ()).model_dump(mode="json")
    _run(choices, plan, {"verb": "calibrate", "settings": json.dumps(settings, sort_keys=True)})


@_with_fleet_choices
def monitor(
    choices: FleetChoices,
    calibration: Annotated[
        Path, typer.Option(help="calibration.yaml of all, or a folder with VESSEL.yaml for each vessel.")
    ],
) -> None:
    """Has a camera moved in any of many recordings? Each is compared with the calibration of its vessel.

    Example: [cyan]rigwake fleet monitor list.csv --calibration calibrations/ --out OUT[/cyan]
    """
    require_there(calibration, choices.topics)
    _run(choices, _plan(choices), {"verb": "monitor", "calibration": str(calibration.absolute())})


COMMANDS = {"calibrate": calibrate, "monitor": monitor}


def _plan(choices: FleetChoices) -> FleetPlan:
    """What was asked for, checked before what computes is imported."""
    require_writable("--out", choices.out_folder, folder=True)
    require_writable("--json", choices.json_file)
    require_number("--timeout", choices.timeout, above=0)
    require_number("--memory", choices.memory, above=0)
    part = _shard(choices.shard)
    require_scheduler(choices.scheduler)
    from rigwake.fleet.fleet_run import FleetPlan

    return FleetPlan(
        choices.out_folder,
        choices.scheduler,
        choices.jobs or os.cpu_count() or 1,
        choices.retries,
        part,
        choices.retry_failed,
    )


def _shard(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    index, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= index <= count:
        raise UsageError(
            f"--shard {text[:40]!r} is no part.", remedy="Give I/N with I from 1 to N, as in 3/8."
        )
    return index, count


def _run(choices: FleetChoices, plan: FleetPlan, values: dict[str, Any]) -> None:
    from rigwake.fleet.fleet_jobs import FleetJob
    from rigwake.fleet.fleet_run import run_fleet
    from rigwake.fleet.recording_list import list_recordings
    from rigwake.readers.topics import TopicMap

    chosen = TopicMap.from_options(choices.topic or (), choices.topics)
    listed, again = list_recordings(choices.recordings, choices.vessel, plan.out)
    values["topics"] = json.dumps({role: dict(names) for role, names in chosen.roles.items()}, sort_keys=True)
    values["timeout_s"] = choices.timeout
    values["memory_bytes"] = None if choices.memory is None else math.ceil(choices.memory * _GIB)
    own = _calibrations(listed, values.pop("calibration", None))
    none: dict[str, Any] = {}
    fleet = [
        FleetJob(found.path, str(plan.out.resolve()), found.vessel, **values, **own.get(found.vessel, none))
        for found in listed
    ]
    if again:
        out.print(f"[dim]{again} recordings were named more than once; each is done once.[/dim]")
    with progress_bar() as bar:
        task = bar.add_task("fleet", total=len(fleet))
        result = run_fleet(
            fleet,
            plan,
            lambda done, total, words: bar.update(
                task, description=f"fleet: {words}", completed=done, total=total
            ),
        )
    if choices.json_file is not None:
        write_json(choices.json_file, _as_dict(result))
    if str(choices.json_file) != "-":
        _print_result(result)
    _end(result, choices.allow_partial)


def _calibrations(listed: Sequence[ListedRecording], path: str | None) -> dict[str, dict[str, Any]]:
    """By vessel: the calibration to compare with and its hash. UsageError for a vessel without one."""
    if path is None:
        return {}
    from rigwake.calibration import load_calibration
    from rigwake.fingerprint import input_fingerprint

    found: dict[str, dict[str, Any]] = {}
    for vessel in dict.fromkeys(one.vessel for one in listed):
        file = Path(path)
        if file.is_dir():
            choices = [file / f"{vessel}.yaml", file / vessel / "calibration.yaml"]
            inside = [c for c in choices if c.is_file() and file.resolve() in c.resolve().parents]
            if not inside:
                raise UsageError(
                    f"No calibration of the vessel {vessel!r} is in {file}.",
                    consequence="Nothing was computed.",
                    remedy=f"Put it there as {choices[0].name}, or name the vessel in the list: PATH,VESSEL.",
                )
            file = inside[0]
        load_calibration(file)  # what is wrong with it is told before the work
        found[vessel] = {
            "calibration": str(file.resolve()),
            "inputs_sha256": input_fingerprint(file)["sha256"],
        }
    return found


def _as_dict(result: FleetResult) -> dict[str, Any]:
    return {
        "counts": dict(result.counts),
        "causes": dict(result.causes),
        "done_before": result.done_before,
        "page": str(result.tables.page),
        "csv": str(result.tables.csv),
        "parquet": None if result.tables.parquet is None else str(result.tables.parquet),
    }


def _print_result(result: FleetResult) -> None:
    from rigwake.fleet.fleet_run import counts_in_words

    out.print(
        f"[bold]{escape(counts_in_words(result.counts, result.causes))}[/bold]",
        highlight=False,
        soft_wrap=True,
    )
    if result.done_before:
        out.print(f"[dim]{result.done_before} of them were done before.[/dim]")
    if result.tables.parquet is None:
        out.print(
            "[dim]note: no fleet.parquet without the package pyarrow: pip install 'rigwake\\[fleet]'[/dim]"
        )
    out.print(f"written: {escape(str(result.tables.page))}", soft_wrap=True, highlight=False)


def _end(result: FleetResult, allow_partial: bool) -> None:
    counts = result.counts
    good = sum(counts[status] for status in ("calibrated", "ok", "suspect", "drifted"))
    if counts["drifted"]:
        raise typer.Exit(5)
    if result.total and not good:
        raise EstimationError(
            "No recording gave a result.",
            consequence=f"The reasons are in {result.tables.page}.",
            remedy="See what `rigwake inspect` says of one of them.",
        )
    if good < result.total and not allow_partial:
        raise PartialResultError(
            f"{result.total - good} of {result.total} recordings gave no result.",
            consequence=f"The reasons are in {result.tables.page}.",
            remedy="With --allow-partial, such a run counts as done (exit code 0); --retry-failed tries them again.",
        )
