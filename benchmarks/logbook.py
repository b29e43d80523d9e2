"""The logbook under fire: 8 processes, 1000 writes, one of them killed at random; twenty times.

python benchmarks/logbook.py [ROUNDS]

Every round checks that nothing acknowledged is lost, nothing is half-written, and a copy taken in mid-write opens
(see `crash_round` in tests/test_logbook.py).
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

from rigwake.logbook.store import Logbook
from test_logbook import calibration, crash_round

WRITERS, EACH = 8, 125


def main() -> None:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    rng = random.Random(0)
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        for k in range(rounds):
            path = Path(name) / f"vessel{k}.db"
            with Logbook(path, create=True) as book:
                book.add(calibration(), 1)
            acknowledged = crash_round(path, WRITERS, EACH, rng)
            print(
                f"round {k + 1:2d}: {acknowledged} writes acknowledged, all there, none in half", flush=True
            )
    print(f"{rounds} rounds in {time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
