"""Run benchmarks, keep what they print as one JSON each, and make the pages of docs/measurements from these.

    python benchmarks/record.py NAME [ARGUMENTS OF THE BENCHMARK]   # run one and keep its result
    python benchmarks/record.py --all                               # run all (`make bench`)
    python benchmarks/record.py --pages                             # only make the pages again

A page says honestly when nothing was run: there is no JSON then. Figures elsewhere link to these pages.
"""

from __future__ import annotations

import ast
import datetime
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "docs" / "measurements"
# tools beside the benchmarks: they measure nothing by themselves, or make inputs
TOOLS = {
    "record",
    "semi_real",
    "train_segmentation",
    "segmentation_scenes",
    "view_shots",
    "recording_faults",
    "monitor_watches",
    "monitor_roc",
}
LIBRARIES = ("rigwake", "numpy", "scipy", "numba", "opencv-contrib-python-headless")


def names() -> list[str]:
    """All benchmarks, in the order of the alphabet."""
    return sorted({path.stem for path in Path(__file__).parent.glob("*.py")} - TOOLS)


def description(name: str) -> tuple[str, str]:
    """First sentence and the rest of a benchmark's docstring."""
    text = ast.get_docstring(ast.parse((Path(__file__).parent / f"{name}.py").read_text())) or name
    first, _, rest = text.partition("\n\n")
    return " ".join(first.split()), rest


def machine() -> dict[str, Any]:
    """What a figure of time depends on; nothing that names the host."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        cpu = next((x.split(":")[1].strip() for x in info.read_text().splitlines() if "model name" in x), cpu)
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "system": platform.system(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES},
        "load_before": [round(x, 1) for x in os.getloadavg()],
    }


def without_paths(text: str) -> str:
    """Text without the folders of this machine."""
    for folder, word in ((ROOT, "."), (ROOT.parent, ".."), (Path.home(), "~")):
        if folder != Path("/"):
            text = text.replace(str(folder), word)
    text = re.sub(r"(?<=-folder )/tmp/\S+", "FOLDER", text)
    text = re.sub(r"/tmp/[\w.-]+", "/tmp/...", text)
    # what else is absolute: its last part says enough
    return re.sub(r"(?<![\w./:~])/(?!tmp/)(?:[\w.-]+/)+(?=[\w.-])", ".../", text)


def run(name: str, arguments: list[str]) -> dict[str, Any]:
    """Run a benchmark, show what it prints, and keep it as JSON if it succeeds."""
    conditions = machine()
    started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, str(Path("benchmarks") / f"{name}.py"), *arguments]
    rows: list[str] = []
    with subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            rows.append(without_paths(line.rstrip()))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    result = {
        "benchmark": name,
        "command": without_paths(" ".join(["python", f"benchmarks/{name}.py", *arguments])),
        "date": datetime.date.today().isoformat(),
        "machine": conditions,
        "seconds": round(time.perf_counter() - started, 1),
        "cpu_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "exit_code": process.returncode,
        "rows": rows,
    }
    if process.returncode == 0:
        PAGES.mkdir(parents=True, exist_ok=True)
        (PAGES / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    else:
        print(f"{name}: exit {process.returncode}, nothing was kept", file=sys.stderr)
    return result


def known(name: str) -> dict[str, Any] | None:
    """What was kept of a benchmark, or None if it was not run."""
    path = PAGES / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def page(name: str) -> str:
    """One benchmark's page."""
    first, rest = description(name)
    lines = [f"# {name}", "", first, ""]
    found = known(name)
    if found is None:
        lines += ["**Not run** for this version: no figures are kept.", ""]
        lines += [f"To run it: `python benchmarks/record.py {name}`.", ""]
    else:
        host = found["machine"]
        libraries = ", ".join(f"{key} {value}" for key, value in host["libraries"].items())
        lines += [
            f"`{found['command']}`, {found['date']}, {found['seconds']} s ({found['cpu_seconds']} CPU-s of it).",
            f"{host['cores']} cores, {host['cpu']}, {host['system']}, Python {host['python']}, {libraries}.",
            f"Load before the start: {host['load_before'][0]}. Times on a busy machine are upper limits.",
            "",
            "```text",
            *found["rows"],
            "```",
            "",
        ]
    if rest:
        lines += ["What it does:", "", "```text", *rest.splitlines(), "```", ""]
    return "\n".join(lines)


def index() -> str:
    """The list of all benchmarks, with the date of the figures."""
    lines = [
        "# Measurements",
        "",
        "Made by `make bench` from one JSON per benchmark, which stands beside each page: command, date, machine,",
        "and every line that was printed. Pages are written by `benchmarks/record.py`, never by hand.",
        "",
        "| benchmark | what | figures of |",
        "|---|---|---|",
    ]
    for name in names():
        found = known(name)
        lines.append(
            f"| [{name}]({name}.md) | {description(name)[0]} | {found['date'] if found else 'not run'} |"
        )
    return "\n".join(lines) + "\n"


def pages() -> dict[str, str]:
    """All pages by file name."""
    return {"index.md": index()} | {f"{name}.md": page(name) for name in names()}


def main() -> int:
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return 2
    failed = []
    if sys.argv[1] != "--pages":
        chosen = names() if sys.argv[1] == "--all" else [sys.argv[1]]
        if unknown := [name for name in chosen if name not in names()]:
            print(f"no benchmark {', '.join(unknown)}: choose from {', '.join(names())}", file=sys.stderr)
            return 2
        for name in chosen:
            print(f"== {name}", flush=True)
            if run(name, [] if sys.argv[1] == "--all" else sys.argv[2:])["exit_code"]:
                failed.append(name)
    PAGES.mkdir(parents=True, exist_ok=True)
    for file, text in pages().items():
        (PAGES / file).write_text(text, encoding="utf-8")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
