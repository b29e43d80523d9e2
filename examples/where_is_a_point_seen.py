"""The pixel of one point of the rig frame in every camera: where_is_a_point_seen.py CALIBRATION X Y Z"""

import sys

import numpy as np

import rigwake

calibration = rigwake.load_calibration(sys.argv[1])
points_rig = np.array([[float(word) for word in sys.argv[2:5]]])
for name, camera in calibration.cameras.items():
    if camera.model is None or not camera.is_observable:
        print(f"{name}: its lens or its mounting is not known")
        continue
    pixels, valid = camera.model.project(camera.rig_from_cam.inverse() * points_rig)
    width, height = camera.model.width_px, camera.model.height_px
    inside = bool(valid[0]) and 0 <= pixels[0, 0] < width and 0 <= pixels[0, 1] < height
    print(f"{name}: {pixels[0].round(1)} of {width} x {height}" if inside else f"{name}: not in view")
