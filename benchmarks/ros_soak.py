"""Memory of the ROS node over a long time: a bag played round and round while the node records, and drops old bags.

    python benchmarks/ros_soak.py --minutes 30

Needs ROS 1 (see docs/ros_node.md). Prints the resident memory every half minute, and its growth after
the first two minutes.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from basin_recording import basin, basin_recording
from rigwake.writers.write import write_recording
from ros_graph import RosGraph


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=1.0, help="times real time")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_recording(
            basin_recording(basin(), folder / "memory"), folder / "sail.bag", image_encoding="png"
        )
        graph = RosGraph(folder)
        try:
            soak(graph, folder, options.minutes, options.rate)
        finally:
            graph.close()


def soak(graph: RosGraph, folder: Path, minutes: float, rate: float) -> None:
    node = psutil.Process(graph.start_node("--out", folder / "out", "--record").pid)
    time.sleep(5.0)
    graph.play(folder / "sail.bag", "--loop", f"--rate={rate}")
    begun, seen = time.monotonic(), []
    while (minute := (time.monotonic() - begun) / 60) < minutes:
        time.sleep(30.0)
        for old in sorted((folder / "out").glob("*.bag"))[:-1]:
            old.unlink()
        seen.append((minute, node.memory_info().rss / 2**20))
        print(f"{minute:6.1f} min  {seen[-1][1]:7.1f} MB", flush=True)
        if len(seen) % 6 == 0:
            recording = graph.look("diagnostics")["recording"]
            print(f"            {recording[1]}", flush=True)
            assert recording[0] == 0, recording
        if free_bytes(folder) < 2 << 30:
            graph.look("record", "off"), graph.look("record", "on")
    settled = [rss for minute, rss in seen if minute > 2] or [rss for _, rss in seen]
    cpu = node.cpu_times()
    print(
        f"growth after the first 2 min: {max(settled) - settled[0]:+.1f} MB; CPU {cpu.user + cpu.system:.0f} s"
    )


def free_bytes(folder: Path) -> int:
    return psutil.disk_usage(str(folder)).free


if __name__ == "__main__":
    main()
