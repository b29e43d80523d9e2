"""Do two calibrations of a rig agree within their uncertainty? has_anything_changed.py FIRST SECOND"""

import sys

import rigwake

_SIGMAS = 4.0  # 6 axes of a few cameras exceed this once in thousands of comparisons

first, second = (rigwake.load_calibration(path) for path in sys.argv[1:])
changed = []
for name, difference in rigwake.diff(first, second, ranges_m=[20.0]).items():
    sigmas = "unknown" if difference.sigmas is None else f"{difference.sigmas:.1f}"
    print(f"{name}: {difference.rotation_deg:.4f} deg, {difference.translation_mm} mm, {sigmas} sigmas")
    if difference.sigmas is not None and difference.sigmas > _SIGMAS:
        changed.append(name)
print("changed:", ", ".join(changed) or "nothing")
