"""A calibration in every format that can hold it.

python examples/export_everywhere.py OUT/calibration.yaml FOLDER
"""

import sys
from pathlib import Path

from rigwake.errors import RigwakeError
from rigwake.exporters import FORMATS, export_calibration, read_calibration


def main(calibration_file: str, folder: str) -> None:
    """Write all formats below the folder; say what was converted, and which formats refuse and why."""
    calibration = read_calibration(calibration_file)
    for name, chosen in FORMATS.items():
        target = Path(folder) / name / chosen.usual_file
        try:
            notes = export_calibration(calibration, name, target)
        except RigwakeError as error:
            print(f"{name:14} refused: {error}")
        else:
            print(f"{name:14} {target}", *notes, sep="\n    ")


if __name__ == "__main__":
    main(*sys.argv[1:])
