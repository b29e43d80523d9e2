"""Calibrate a recording, and say what was found or what is missing: calibrate_recording.py RECORDING OUT"""

import sys

import rigwake
from rigwake.errors import RigwakeError, UnobservableError

recording, out = sys.argv[1:]
try:
    calibration = rigwake.calibrate(recording, out, resume=True)
except UnobservableError as error:
    print("The motion is not enough:", error.cause, error.remedy)
except RigwakeError as error:
    print("Failed:", error.cause, error.remedy)
else:
    for name, camera in calibration.cameras.items():
        print(name, camera.rig_from_cam.translation, "+-", camera.std_translation_m, "m")
    print("look at", rigwake.report(out))
