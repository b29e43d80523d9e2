"""Coverage of the main job by the fast suite, one line a package; `make coverage` runs it. Exit 1 below 80 %."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

from coverage import Coverage

PACKAGES = ("pipeline", "ba/solver", "ba/rig", "odometry", "cli")
LEAST = 0.8


def main() -> int:
    measured = Coverage()
    measured.load()
    lines: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0])
    files = []
    for path in sorted((Path(__file__).parent.parent / "src" / "rigwake").rglob("*.py")):
        name = str(path).rpartition("src/rigwake/")[2]
        package = next((p for p in PACKAGES if name.startswith(p + "/")), None)
        if package is None:
            continue
        _, statements, _, missing, _ = measured.analysis2(str(path))
        lines[package][0] += len(statements)
        lines[package][1] += len(statements) - len(missing)
        if missing:
            files.append((1 - len(missing) / len(statements), name, len(missing)))
    for fraction, name, count in sorted(files):
        print(f"{fraction:5.0%}  {count:4d} lines not run  {name}")
    for package in PACKAGES:
        total, run = lines[package]
        print(f"{run / max(total, 1):5.0%} of {total:5d} lines  {package}")
    return int(any(run < LEAST * total for total, run in lines.values()))


if __name__ == "__main__":
    sys.exit(main())
