"""ATE of several trajectories against a known one, best first: trajectory_errors.py TRUTH FOUND..."""

import sys

import rigwake

truth, *found = sys.argv[1:]
errors = {path: rigwake.evaluate(path, truth) for path in found}
for path, error in sorted(errors.items(), key=lambda item: item[1].absolute.rmse_m):
    absolute = error.absolute
    print(
        f"{path}: {absolute.rmse_m:.4f} m, {absolute.rotation_rmse_deg:.4f} deg "
        f"over {absolute.pairs} poses, aligned by {error.alignment}"
    )
    if error.kitti is not None:
        print(f"  KITTI: {error.kitti.t_rel_percent:.3f} %, {error.kitti.r_rel_deg_per_100m:.4f} deg / 100 m")
