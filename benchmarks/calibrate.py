"""The rig of recordings with known truth, by method: thesis pipeline, hand-eye only, rig bundle adjustment
without and with cross-camera association.

    python benchmarks/calibrate.py [--peers] [RECORDING TRUTH | PRESET]...
    python benchmarks/calibrate.py --nees [--keep FOLDER] [NAME]...
    python benchmarks/calibrate.py --checks RECORDING...

Without arguments: `harbour_a` and `kitti_03_split` in RIGWAKE_DATA, or in ../shared/data beside the project, and the
presets `demo` and `thesis_lively`, which are rendered first. --peers: pycolmap too, see `colmap_rig.py` (some ten
minutes). Errors are those of the worst camera in the frame of the reference, and of the worst pair, which needs no
common reference; NEES is that of the best and of the worst camera, and 6 is expected.
Seconds and peak memory are of the whole process and its children, from images to calibration; `hand-eye only` stops
before the bundle adjustment, so it has no figures of its own.

--nees: are the deviations honest? Small rendered recordings (three cameras, half a minute) of three layouts on calm and
rough water, with RTK, a receiver of a metre whose error lasts, and none; NEES per degree of freedom of every camera in
the frame of the IMU, its mean and its largest. 1 is expected. Ends with exit code 1 if the mean is not in 0.6-1.6 or
a camera is above 3. --keep: recordings and calibrations stay in FOLDER, and what is there is taken again.

--checks: what comparing the sensors costs, in a calibration of each recording. Cameras' coarse turns are not counted:
they are what tracking starts from, compared or not. Ends with exit code 1 above 10 %.
"""

import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import yaml

from rigwake.api import simulate
from rigwake.calibration import Calibration, load_calibration
from rigwake.config import load_config
from rigwake.errors import RigwakeError
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.handeye.handeye_problem import HandeyeOptions
from rigwake.handeye.joint_calibration import calibrate_handeye
from rigwake.odometry.metric import metric_start
from rigwake.odometry.thesis_odometry import estimate_thesis
from rigwake.pipeline import calibration_run, sensor_checks, vetted_rig
from rigwake.pipeline.calibration_run import calibrate
from rigwake.pipeline.camera_stage import tracks_file
from rigwake.readers.open import open_recording
from rigwake.readers.truth_files import read_true_rig, rig_in_frame
from rigwake.rig import Rig
from rigwake.simulation.scenario import load_scenario
from rigwake.tracks import load_tracks

METHODS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("as it comes", ()),
    ("lenses held", ("intrinsics=fixed",)),
    ("no cross-camera association", ("adjustment.cross_camera=false",)),
)
CHECKS = (  # where sensors are compared, all in the process that `calibrate` runs in
    (calibration_run, "vet_imu"),
    (vetted_rig, "mend_lenses"),
    (vetted_rig, "vet_sensors"),
    (calibration_run, "knocks_inside"),
    (sensor_checks, "visual_rotations"),
)
PEER_RATE_HZ = 1.0  # all pairs of images are matched: twice the rate takes four times as long
SMALL = 0.75  # of the presets' pictures
# name -> preset, significant wave height in metres, receiver
HONEST: dict[str, tuple[str, float, str]] = {
    "demo_calm_rtk": ("demo", 0.03, "rtk"),
    "demo_waves_metre": ("demo", 0.25, "metre"),
    "demo_rough_none": ("demo", 0.6, "none"),
    "marina_calm_rtk": ("marina", 0.02, "rtk"),
    "marina_waves_none": ("marina", 0.3, "none"),
    "quay_calm_metre": ("quay", 0.02, "metre"),
    "quay_waves_rtk": ("quay", 0.2, "rtk"),
    "demo_rough_rtk": ("demo", 0.7, "rtk"),
}
NEES_MEAN, NEES_WORST = (0.6, 1.6), 3.0  # per degree of freedom
DATA = Path(os.environ.get("RIGWAKE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def cpu_s() -> float:
    own, children = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def peak_gb() -> float:
    return (
        max(resource.getrusage(w).ru_maxrss for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 2**20
    )


def row(name: str, method: str, found: Calibration | str, truth: Rig, used: str) -> None:
    if isinstance(found, str):
        print(f"| {name} | {method} | – | – | – | – | – | {used} {found} |", flush=True)
        return
    errors = evaluate_calibration(found, rig_in_frame(truth, found.reference))
    turn = max(camera.rotation_error_deg for camera in errors.cameras.values())
    shift = max(camera.translation_error_norm_m for camera in errors.cameras.values())
    pair_turn = max(pair.rotation_error_deg for pair in errors.pairs)
    pair_shift = max(pair.translation_error_m for pair in errors.pairs)
    known = [camera.nees for camera in errors.cameras.values() if camera.nees is not None]
    nees = f"{min(known):.1f}-{max(known):.1f}" if known else "–"
    print(
        f"| {name} | {method} | {turn:.4f} | {1000 * shift:.1f} | {pair_turn:.4f} | {1000 * pair_shift:.1f} | "
        f"{nees} | {used} |",
        flush=True,
    )


def thesis_pipeline(recording: Path, out: Path) -> Calibration | str:
    """Frame-to-frame odometry of every camera's tracks, put into metres by GNSS, then the thesis hand-eye."""
    opened = open_recording(recording)
    gnss = next(iter(opened.gnss.values()), None)
    try:
        paths = [
            metric_start(estimate_thesis(load_tracks(tracks_file(out, name)), stream.model), None, gnss)
            for name, stream in opened.cameras.items()
            if stream.model is not None
        ]
        metric = [path.world_from_cam for path in paths]
        return calibrate_handeye(metric[0], metric[1:], HandeyeOptions(method="thesis")).calibration()
    except RigwakeError as error:
        return str(error.cause)


def pycolmap_rig(recording: Path) -> Calibration | str:
    """The peer, with one image per camera and second."""
    from colmap_rig import colmap_rig

    try:
        return colmap_rig(recording, PEER_RATE_HZ)
    except RigwakeError as error:
        return str(error.cause)


def calibrated(
    name: str, truth: Rig, method: str, settings: tuple[str, ...], out: Path, *, resumed: bool, given: Path
) -> None:
    """Prints a row of the table."""
    wall, cpu = time.perf_counter(), cpu_s()
    try:
        found: Calibration | str = calibrate(
            given, out, load_config(None, settings), resume=resumed
        ).calibration
    except RigwakeError as error:
        found = str(error.cause)
    wall, cpu = time.perf_counter() - wall, cpu_s() - cpu
    tracked = " after tracking" if resumed else f", peak {peak_gb():.2f} GB"
    row(name, method, found, truth, f"{cpu:.0f} CPU s, {wall:.0f} s{tracked}")


def compare(recording: Path, truth_file: Path, peers: bool) -> None:
    name, truth = recording.stem, read_true_rig(truth_file)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        for method, settings in METHODS:
            calibrated(name, truth, method, settings, out, resumed=bool(settings), given=recording)
        row(name, "hand-eye only", load_calibration(out / "initial_rig.yaml"), truth, "")
        cpu = cpu_s()
        found = thesis_pipeline(recording, out)
        row(name, "thesis pipeline", found, truth, f"{cpu_s() - cpu:.0f} CPU s after tracking")
    if peers:
        wall, cpu = time.perf_counter(), cpu_s()
        found = pycolmap_rig(recording)
        wall, cpu = time.perf_counter() - wall, cpu_s() - cpu
        row(name, f"pycolmap, {PEER_RATE_HZ:g} Hz", found, truth, f"{cpu:.0f} CPU s, {wall:.0f} s")


def cost_of_checks(recordings: list[Path]) -> None:
    """One row per recording: CPU seconds of every comparison, and their part of the run."""
    print("| recording | comparing the sensors (asked 10 %) | of it | the run |\n|---|---|---|---|")
    for recording in recordings:
        spent: dict[str, float] = {name: 0.0 for _, name in CHECKS}
        with ExitStack() as patches, tempfile.TemporaryDirectory() as out:
            for module, name in CHECKS:
                patches.enter_context(
                    mock.patch.object(module, name, timed(getattr(module, name), name, spent))
                )
            started = cpu_s()
            calibrate(recording, out, load_config(None, ()))
            whole = cpu_s() - started
        spent["vet_imu"] -= spent.pop("visual_rotations")
        used = sum(spent.values())
        words = ", ".join(f"{name} {seconds:.1f}" for name, seconds in spent.items())
        added = 100 * used / (whole - used)
        print(
            f"| {recording.stem} | {used:.1f} CPU s, {added:+.1f} % | {words} | {whole:.0f} CPU s |",
            flush=True,
        )


def timed(call: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    """The same, adding its CPU seconds to those spent under `name`."""

    def counted(*arguments: Any, **options: Any) -> Any:
        started = time.process_time()
        try:
            return call(*arguments, **options)
        finally:
            spent[name] += time.process_time() - started

    return counted


def compare_preset(preset: str, peers: bool) -> None:
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / f"{preset}.bag"
        simulate(preset, recording, jobs=2)
        compare(recording, Path(folder) / f"{preset}_truth" / "truth.yaml", peers)


def small_scenario(name: str, folder: Path) -> Path:
    """A scenario file of one of `HONEST`."""
    preset, waves_m, receiver = HONEST[name]
    document = load_scenario(preset).model_dump(mode="json")
    document["name"], document["sea"]["hs_m"] = name, waves_m
    document["seed"] = 100 + list(HONEST).index(name)
    document["cameras"] = [c for c in document["cameras"] if c["name"] != "back"]
    for camera in document["cameras"]:
        for size in ("width_px", "height_px"):
            camera[size] = round(SMALL * camera[size])
        camera["params"] |= {k: SMALL * camera["params"][k] for k in ("fx", "fy", "cx", "cy")}
    metre = {"white_std_m": 0.25, "correlated_std_m": 1.0, "correlated_tau_s": 40.0, "quality": "standalone"}
    document["gnss"] = (
        None if receiver == "none" else document["gnss"] | (metre if receiver == "metre" else {})
    )
    file = folder / f"{name}.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def honesty(names: list[str], folder: Path) -> int:
    """One row per recording: NEES per degree of freedom of every camera, errors, deviations of the heights."""
    print("| recording | NEES per dof, by camera | worst deg | worst mm | used |\n|---|---|---|---|---|")
    found: list[float] = []
    for name in names:
        recording, out, started = folder / name, folder / f"{name}_out", cpu_s()
        if not recording.exists():
            simulate(small_scenario(name, folder), recording, jobs=1)
        if not (out / "calibration.yaml").exists():
            calibrate(recording, out, load_config(None, ("reference=imu",)), resume=out.exists())
        truth = rig_in_frame(read_true_rig(folder / f"{name}_truth" / "truth.yaml"), "imu")
        errors = evaluate_calibration(load_calibration(out / "calibration.yaml"), truth).cameras
        nees = {n: e.nees / e.nees_dof for n, e in errors.items() if e.nees is not None}
        found += nees.values()
        words = ", ".join(f"{n} {value:.2f}" for n, value in nees.items())
        turn = max(e.rotation_error_deg for e in errors.values())
        shift = max(e.translation_error_norm_m for e in errors.values())
        print(
            f"| {name} | {words} | {turn:.4f} | {1000 * shift:.1f} | {cpu_s() - started:.0f} CPU s |",
            flush=True,
        )
    mean, worst = sum(found) / max(len(found), 1), max(found, default=0.0)
    print(f"\nmean {mean:.2f} over {len(found)} cameras of {len(names)} recordings; largest {worst:.2f}")
    return int(not (NEES_MEAN[0] <= mean <= NEES_MEAN[1] and worst <= NEES_WORST))


def main() -> None:
    given = [argument for argument in sys.argv[1:] if argument != "--peers"]
    if "--checks" in given:
        given.remove("--checks")
        if not given:
            sys.exit("--checks needs recordings: python benchmarks/calibrate.py --checks REC..")
        cost_of_checks([Path(argument) for argument in given])
        return
    if "--nees" in given:
        given.remove("--nees")
        with tempfile.TemporaryDirectory() as folder:
            kept = Path(folder)
            if "--keep" in given:
                kept = Path(given.pop(given.index("--keep") + 1))
                given.remove("--keep")
                kept.mkdir(parents=True, exist_ok=True)
            sys.exit(honesty(given or list(HONEST), kept))
    if not given:
        for name, file in (("harbour_a", "harbour_a.bag"), ("kitti_03_split", "")):
            given += [str(DATA / name / file), str(DATA / name / "truth.yaml")]
        given += ["demo", "thesis_lively"]
    print(
        "| recording | method | camera deg | camera mm | pair deg | pair mm | NEES | used |\n"
        + "|---" * 8
        + "|"
    )
    while given:
        first = given.pop(0)
        if Path(first).exists():
            compare(Path(first), Path(given.pop(0)), "--peers" in sys.argv)
        else:
            compare_preset(first, "--peers" in sys.argv)


if __name__ == "__main__":
    main()
