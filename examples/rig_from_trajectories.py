"""A rig from one trajectory per body, by any odometry: rig_from_trajectories.py REFERENCE OTHER..."""

import sys

import numpy as np

import rigwake

reference, *others = sys.argv[1:]
result = rigwake.handeye(reference, *others)
np.set_printoptions(precision=4, suppress=True)
for name, body in result.members.items():
    print(
        f"{name} in {result.reference}: at {body.rig_from_cam.translation} m, sigma {body.std_translation_m} m"
    )
    print(f"  quaternion wxyz {body.rig_from_cam.quat_wxyz}, sigma {body.std_rotation_deg} deg")
    for direction in body.unobservable:
        print(f"  unobservable: {direction.words}. {direction.remedy}")
