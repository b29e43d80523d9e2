"""Every option of every verb is used once through the command line, and every `next:` works when typed."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from board_simulation import looking_poses, simulated_corners
from calibrated_rigs import PINHOLE, boat
from cli_runs import START_NS, Ended, commands_by_words, run, write_examples
from rigwake.cameras.formats.camera_files import write_cameras
from rigwake.cameras.registry import CAMERA_CLASSES
from rigwake.cli import options as cli_options
from rigwake.cli.main import GROUPS, VERBS
from rigwake.exporters import FORMATS
from rigwake.intrinsics.boards import parse_board
from rigwake.logbook.store import Logbook
from rigwake.simulation.scenario import preset_names

SIMPLY_EXPORTED = [name for name in FORMATS if name not in ("basalt", "mrcal", "opencv", "ros-static-tf")]

# (command, exit codes that are right, words of the output); names in braces are files of `write_examples`
USED = [
    ("--version", 0, "rigwake "),
    ("--help", 0, "Exit codes"),
    (
        "calibrate --print-config --set seed=5 --jobs 2 --start 1 --duration 20 --cameras front,left --reference front",
        0,
        "seed: 5",
    ),
    ("calibrate --print-config --precision 5mm,0.02deg --budget 120", 0, "budget_s: 120"),
    ("calibrate --print-config --intrinsics find --fov front=185 --fov 90", 0, "front: 185.0"),
    ("calibrate --print-config --fov front=wide", 2, "is no number of degrees"),
    ("calibrate --print-config --all", 0, "use_all: true"),
    ("calibrate --print-config --seed 7 --config {settings}", 0, "min_duration_s: 2"),
    (
        "calibrate {images} -o {here}/c1 --topic camera.front=/a --topics {topics} --allow-partial",
        3,
        "3.0 s of images",
    ),
    (
        "calibrate {images} --out {here}/c2 --trajectories {here} --prior {good_prior} --resume --json {here}/c.json",
        3,
        "3.0 s",
    ),
    ("calibrate {images} -o {here}/c3 --force --view", 3, "3.0 s of images"),
    ("inspect {images} --camera-file front={lens}", (0, 1, 2), ""),
    ("calibrate {images} -o {here}/c4 --camera-file front={lens} --repair", (2, 3), ""),
    ("calibrate {images} -o {here}/c6 --horizon off --intrinsics fixed", 3, "3.0 s of images"),
    ("calibrate {images} -o {here}/c5 --no-repair", 3, "3.0 s of images"),
    ("odometry {images} -o {here}/o5 --camera front --no-repair", 1, ""),
    ("odometry {images} -o {here}/o6 --camera front --repair", 1, ""),
    ("odometry {images} -o {here}/o4 --camera front --camera-file front={lens}", (1, 2), ""),
    ("inspect {images} --json - --topic camera.front=/a --topics {topics}", 0, '"verdict"'),
    ("inspect {images} --html {here}/page.html", 0, "Not enough to calibrate"),
    (
        "odometry {images} -o {here}/o1 --camera all --front-end klt --method thesis --no-imu --no-gnss --no-attitude "
        "--no-hull --no-horizon --loops --no-refine-lens --mask {mask} --seed 3 --jobs 1 --allow-partial "
        "--topic camera.front=/a --topics {topics} --json {here}/o.json",
        1,
        "",
    ),
    (
        "odometry {images} --out {here}/o2 --camera front --imu --gnss --attitude --hull --horizon on --refine-lens",
        1,
        "no frames",
    ),
    (
        "odometry {images} -o {here}/o7 --stereo front,left --rig {calibration}",
        2,
        "No camera 'left' in this rig.",
    ),
    ("odometry {images} --output {here}/o3 --camera front --front-end orb", 1, "no frames"),
    (
        "handeye {rig_tum} {port_tum} -o {here}/h.yaml --method ml --noise increments --time-offset",
        0,
        "next:",
    ),
    (
        "handeye {rig_tum} {port_tum} {starboard_tum} --method thesis --no-time-offset --scale --json -",
        0,
        '"members"',
    ),
    ("handeye {rig_tum} {port_tum} --out {here}/h2.yaml --noise poses --no-time-offset", 0, "next:"),
    ("handeye {rig_tum} {port_tum} --output {here}/h3.yaml", 0, "next:"),
    (
        "undistort {images} --camera front --to cylinder --focal 40 --every 2 -o {here}/u1",
        (0, 1),
        "",
    ),
    ("undistort {mask} --camera-file {lens} --out {here}/u2", 0, "files in"),
    ("undistort {mask} --camera-file {lens} --camera front --focal 40 --output {here}/u3", 0, "files in"),
    (
        "handeye {rig_tum} {port_tum} -o {here}/h9.yaml --frame enu --columns _",
        (0, 1, 2),
        "",
    ),
    (
        "convert {images} -o {here}/v1 --to folder --images png --cameras front --start 0 --duration 2 --every 2 "
        "--topic camera.front=/a --topics {topics} --camera-file front={lens} --json {here}/v1.json",
        (0, 1, 2),
        "",
    ),
    ("evaluate {calibration} --truth {calibration} --frame imu", (0, 1, 2), ""),
    ("convert {images} --out {here}/v2.bag", 0, "next:"),
    ("convert {images} --output {here}/v3.mcap", 0, "next:"),
    (
        "intrinsics {corners} --board chessboard:9x6:0.03 --image-size 640x480 --model kb4 --fix k4 --free k3 --fov 90 "
        "--name front -o {here}/front.yaml --plots {here}/plots --json {here}/front.json",
        0,
        "written:",
    ),
    ("intrinsics {corners} --image-size 640x480 --model kb4 --fix k4 --out {here}/k.yaml", 0, "written:"),
    ("intrinsics {corners} --image-size 640x480 --model kb4 --fix k4", 0, "next:"),
    ("intrinsics {corners} --output {here}/d.yaml", 2, "needs the image size"),
    ("evaluate {calibration} --truth {calibration} --gauge align --json {here}/e.json", 0, "next:"),
    ("evaluate {taken}/calibration.yaml --truth {calibration}", 0, "next:"),
    (
        "evaluate {port_tum} --truth {rig_tum} --alignment sim3 --max-difference 0.02 "
        "--html {here}/t.html --json {here}/t.json",
        0,
        "ATE, RMS",
    ),
    ("evaluate {port_tum} --truth {port_tum}", 0, "next:"),
    ("diff {calibration} {calibration} --range 10 --range 50 --json {here}/d.json", 0, "at 50 m"),
    ("diff {calibration} {open}", 0, "next:"),
    ("diff {calibration} {open} --html {here}/diff.html", 0, "next:"),
    ("handeye {rig_tum} {port_tum} -o {here}/h12.yaml --html {here}/handeye.html", 0, "mountings observable"),
    ("intrinsics {images} --from-motion --fov 85", 3, "3.0 s of images"),
    ("intrinsics {corners} --image-size 640x480 --fov front=90", 2, "one --fov holds for every lens"),
    ("intrinsics {corners} --image-size 640x480 --model kb4 --html {here}/lens.html", 0, "written:"),
    (
        "intrinsics {images} --camera all --board chessboard:9x6:0.03 --topic camera.front=/a --topics {topics}",
        1,
        "no chessboard of 9 x 6 inner corners was found in 4 of its 4 frames",
    ),
    *(
        (f"export {{calibration}} --to {name} -o {{here}}/exports/{name}", 0, "next:")
        for name in FORMATS
        if name not in ("basalt", "mrcal", "opencv", "ros-static-tf")
    ),
    ("export {calibration} --to opencv --out {here}/opencv.yaml --max-fit-error 1", 0, "next:"),
    ("export {calibration} --to mrcal --output {here}/mrcal", 0, "next:"),
    ("export {calibration} --to basalt --imu {imu} -o {here}/basalt.json", (0, 1), ""),
    (
        "export {calibration} --to ros-static-tf --parent-frame base --child-frame cam_{{name}} -o {here}/tf.launch.py",
        0,
        "next:",
    ),
    ("export {open} --to urdf --allow-unobservable -o {here}/open.urdf", 0, "next:"),
    ("report {taken} --open --figures {here}/figures --figure-format svg", 0, "next:"),
    ("report {taken} --rrd {here}/rig.rrd", (0, 1, 2), ""),
    ("report {taken} --view", (0, 1, 2), ""),
    ("simulate demo --show --duration 5 --seed 3", 0, "duration_s: 5"),
    ("simulate {list} -o {here}/s.bag --jobs 1 --workers 1 --truth-images --no-show", 2, "list.yaml"),
    ("simulate demo --out {here}/s.xyz", 2, "suffix"),
    ("simulate demo --output {here}/s.xyz", 2, "suffix"),
    # a folder without pictures, and a calibration of another vessel: refused before any work
    (
        "segment {here} -o {here}/g1 --calibration {calibration} --method colour --onnx {mask} --classes water,sky "
        "--count 1 --measure {here} --horizon-row 5 --field-deg 60 --height-m 2 --topic camera.front=/a "
        "--topics {topics} --json {here}/g1.json",
        (1, 2),
        "",
    ),
    ("segment {here} --out {here}/g2 --count 0", 2, "at least one"),
    ("segment {here} --output {here}/g3 --count 0", 2, "at least one"),
    (
        "stixels {calibration} {images} -o {here}/x1 --height-m 2 --count 1 --onnx {mask} --classes water,sky "
        "--match --radius-m 30 --topic camera.front=/a --topics {topics} --json {here}/x1.json",
        (1, 2),
        "",
    ),
    ("stixels {calibration} {images} --out {here}/x2 --no-match --count 0", 2, "at least one"),
    ("stixels {calibration} {images} --output {here}/x3 --count 0", 2, "at least one"),
    (
        "depth {calibration} {images} -o {here}/d1 --at 1 --count 1 --height-m 2 --nearest-m 3 --sweep "
        "--topic camera.front=/a "
        "--topics {topics} --json {here}/d1.json",
        (1, 2),
        "",
    ),
    ("depth {calibration} {images} --out {here}/d2 --count 0", 2, "at least one"),
    ("depth {calibration} {images} --output {here}/d3 --count 0", 2, "at least one"),
    # a wrong recording, or one too short: refused before any work
    (
        "surround {calibration} {images} -o {here}/s1.png --view topdown --at 1 --size 64x32 --stabilise off "
        "--surface water --shell-m 30 --height-m 2 --hull mask --radius-m 20 --bumper-m 3 --vessel 12x4 --yaw 10 "
        "--fov 80 --trajectory {rig_tum} --topic camera.front=/a --topics {topics} --json {here}/s1.json",
        (0, 1, 2, 3),
        "",
    ),
    ("surround {calibration} --serve --host 127.0.0.1 --from front", 2, "CAMERA=URL"),
    (
        "surround {calibration} {images} --out {here}/s2.xyz --camera-file front={lens}",
        2,
        "what should .xyz be",
    ),
    ("surround {calibration} {images} --output {here}/s3.xyz", 2, "what should .xyz be"),
    (
        "monitor {calibration} {images} -o {here}/m1 --log {here}/m1.db --topic camera.front=/a --topics {topics} "
        "--camera-file front={lens} --json {here}/m1.json",
        1,
        "not of the calibrated vessel",
    ),
    ("monitor {calibration} {images} --out {here}/m2", 1, "not of the calibrated vessel"),
    ("monitor {calibration} {images} --output {here}/m3", 1, "not of the calibrated vessel"),
    (
        "recalibrate {calibration} {images} -o {here}/r1.yaml --log {here}/r1.db --topic camera.front=/a "
        "--topics {topics} --camera-file front={lens} --json {here}/r1.json",
        1,
        "not of the calibrated vessel",
    ),
    ("recalibrate {calibration} {images} --out {here}/r2.yaml", 1, "not of the calibrated vessel"),
    ("recalibrate {calibration} {images} --output {here}/r3.yaml", 1, "not of the calibrated vessel"),
    ("log add {here}/new.db {calibration} --from 2026-05-01T08:00 --note spring", 0, "next:"),
    ("log list {logbook} --json -", 0, "calibrations"),
    ("log list {logbook} --json {here}/list.json", 0, "summer"),
    ("log show {logbook} 1 -o {here}/then.yaml", 0, "written"),
    ("log plot {logbook} --out {here}/history.html", 0, "written"),
    ("log export {logbook} --output {here}/copy.db", 0, "written"),
    (
        "fleet calibrate {gone} -o {here}/f1 --jobs 1 --timeout 60 --memory 4 --retries 0 --shard 1/1 --retry-failed "
        "--vessel x --config {settings} --set seed=5 --topic camera.front=/a --topics {topics} --json {here}/f.json",
        1,
        "1 failed (1 missing path)",
    ),
    (
        "fleet calibrate {images} --out {here}/f2 --allow-partial --scheduler tcp://127.0.0.1:9",
        1,
        "No scheduler",
    ),
    (
        "fleet monitor {gone} -o {here}/f3 --calibration {calibration} --jobs 1 --timeout 60 --memory 4 --retries 0 "
        "--shard 1/1 --retry-failed --vessel x --topic camera.front=/a --topics {topics} --json - --allow-partial",
        1,
        '"missing path": 1',
    ),
    (
        "fleet monitor {images} --out {here}/f4 --calibration {calibration} --scheduler tcp://127.0.0.1:9",
        1,
        "No scheduler",
    ),
    (
        "ros node --out {here}/r1 --calibration {calibration} --topic /imu --child-frame cam_{{name}} "
        "--monitor-seconds 30 --surround-hz 2 --ros 1 --record __name:=x",
        1,
        "ROS",
    ),
    ("ros node -o {here}/r2", 1, "ROS"),
    ("calibrate {images} -o {here}/c4 --scheduler local:1", 3, "3.0 s of images"),
    ("demo -o {text}", 2, "is a file"),
    ("demo --out {text}", 2, "is a file"),
    ("demo --output {text}", 2, "is a file"),
]

NOT_TYPED = {
    "--install-completion",
    "--show-completion",
}  # they change the shell's files, or ask which shell it is


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("options")
    names = write_examples(folder)
    (folder / "settings.yaml").write_text("min_duration_s: 2\n")
    (folder / "good_prior.yaml").write_text(
        "baselines: [{cameras: [front, left], distance_m: 1, std_m: 0.1}]\n"
    )
    noise = {"accelerometer_noise_density": 0.01, "accelerometer_random_walk": 2e-4}
    noise |= {
        "gyroscope_noise_density": 1e-3,
        "gyroscope_random_walk": 1e-5,
        "update_rate": 200.0,
        "rostopic": "/imu",
    }
    (folder / "imu.yaml").write_text("".join(f"{key}: {value}\n" for key, value in noise.items()))
    cv2.imwrite(str(folder / "mask.png"), np.full((PINHOLE.height_px, PINHOLE.width_px), 255, np.uint8))
    board, rng = parse_board("chessboard:9x6:0.03"), np.random.default_rng(0)
    seen = simulated_corners(PINHOLE, board, looking_poses(0.35, 8, rng, 0.5), 0.1, rng)
    rows = ["timestamp_ns,tag_id,corner_idx,u_px,v_px,x_m,y_m,z_m"]
    for k, view in enumerate(seen.views):
        for i, ((x, y, z), (u, v)) in enumerate(zip(view.points_board, view.pixels, strict=True)):
            rows.append(f"{START_NS + k},{i},0,{u:.4f},{v:.4f},{x:.5f},{y:.5f},{z:.5f}")
    (folder / "corners.csv").write_text("\n".join(rows) + "\n")
    write_cameras(folder / "lens.yaml", {"front": PINHOLE})
    with Logbook(folder / "vessel.db", create=True) as book:
        book.add(boat(lens=PINHOLE), START_NS, "summer")
    names["logbook"] = folder / "vessel.db"
    for name in ("settings", "good_prior", "imu", "lens"):
        names[name] = folder / f"{name}.yaml"
    (folder / "gone.txt").write_text("gone.bag\n")
    return names | {"gone": folder / "gone.txt", "mask": folder / "mask.png"}


def test_every_option_of_every_verb_is_used() -> None:
    used = [shlex.split(command.replace("{", "").replace("}", "")) for command, _, _ in USED]
    for verb, command in commands_by_words().items():
        own = verb.split()
        words = {word for typed in used if typed[: len(own)] == own for word in typed}
        for parameter in command.params:
            names = (
                {*parameter.opts, *parameter.secondary_opts}
                if parameter.param_type_name == "option"
                else set()
            )
            assert names - NOT_TYPED - {"--help", "-h"} <= words, (
                f"rigwake {verb}: {names - words} is never used"
            )


def parameters() -> list:
    """The table, with what takes seconds among the slow tests."""
    costly = ("--model kb4", "--rrd", "--view", "--figures", "--camera all", "--front-end orb")
    costly += ("--scheduler tcp",)  # each waits for somebody to answer
    return [
        pytest.param(
            *row, id=row[0][:60], marks=[pytest.mark.slow] if any(c in row[0] for c in costly) else []
        )
        for row in USED
    ]


@pytest.mark.parametrize(("command", "code", "said"), parameters())
def test_options_work(
    command: str, code: int, said: str, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files["here"])
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:9")  # nobody answers
    ended = run(*(word.format(**files) for word in shlex.split(command)))
    assert ended.code in (code if isinstance(code, tuple) else (code,)), ended.words
    assert said in ended.words
    assert "Traceback" not in ended.err
    assert "rigwake met" not in ended.err
    check_next_steps(ended, files["here"])


def check_next_steps(ended: Ended, folder: Path) -> None:
    """What a verb names as the next step works when typed: it ends well, or says what the tiny recordings lack."""
    lines = re.findall(r"^next: (rigwake .*?)  \S.*$", ended.out, re.MULTILINE)
    assert len(lines) == ended.out.count("next: ")
    for line in lines:
        verb, *words = shlex.split(line)[1:]
        if verb == "simulate":
            continue
        followed = run(verb, *words)
        assert followed.code == 0 or (verb == "calibrate" and followed.code == 3), f"{line}: {followed.words}"


def test_words_of_help_are_those_of_the_program() -> None:
    assert tuple(FORMATS) == cli_options.EXPORT_FORMATS
    assert set(CAMERA_CLASSES) == set(cli_options.LENS_MODELS)
    assert tuple(preset_names()) == cli_options.PRESETS
    assert cli_options.completed_from(("kalibr", "csv"))("k") == ["kalibr"]


@pytest.mark.parametrize("verb", [*commands_by_words(), *GROUPS])
def test_help_of_every_verb(verb: str) -> None:
    long, short = run(*verb.split(), "--help"), run(*verb.split(), "-h")
    assert long == short
    assert "Exit codes" in long.words
    assert "4 done, but a camera is missing" in long.words


@pytest.mark.parametrize(
    "verb", [verb for verb in VERBS if verb not in ("inspect", "evaluate", "diff", "report")]
)
def test_outputs_have_one_spelling(verb: str) -> None:
    assert "--out" in run(verb, "--help").out
