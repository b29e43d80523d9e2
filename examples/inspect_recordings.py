"""Which of these recordings are enough to calibrate? inspect_recordings.py RECORDING..."""

import sys

import rigwake
from rigwake.errors import RigwakeError

for path in sys.argv[1:]:
    try:
        recording = rigwake.open_recording(path)
        inspection, verdict = rigwake.inspect(recording)
    except RigwakeError as error:
        print(f"{path}: {error.cause}")
        continue
    print(f"{path}: {verdict.word}; cameras: {', '.join(recording.cameras)}")
    for check in verdict.checks:
        if check.passed is False:
            print(f"  {check.name}: {check.measured}")
    for finding in inspection.findings:
        print(f"  {finding.severity}: {finding.sensor}: {finding.message}")
