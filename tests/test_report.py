"""The report is built from whatever a folder holds, says what is missing, and shows no made-up number."""

import json
import re
import shutil
import sys
import time
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calibrated_rigs import boat, camera, without_vertical
from report_folders import GOOD_CHECKS, circle, many_cameras, write_folder, write_residuals, write_tracks
from rigwake.calibration import CalibratedCamera, Calibration, UnobservableDirection, save_calibration
from rigwake.cli.main import build_app
from rigwake.errors import InputError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.report import build_report, load_report_content, summary_lines
from rigwake.report.charts import Series, line_chart, ticks
from rigwake.report.extrinsics import directions, looks, two_digits
from rigwake.report.figures import write_figures
from rigwake.report.motion_figures import motion_of, paths_in_one_world
from rigwake.report.picture_overlays import BUDGET_BYTES
from rigwake.report.report_page import render
from rigwake.report.report_verdict import judge
from rigwake.report.rerun_log import log_to_rerun


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("report") / "out")


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return build_report(folder).read_text()


def test_the_page_stands_alone(page: str) -> None:
    without_data = re.sub(r"data:image/[a-z]+;base64,[A-Za-z0-9+/=]*", "data:", page)
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!data:|#)""", without_data)
    assert "@import" not in without_data
    assert "url(" not in without_data
    assert not re.search(r"\b(?:fetch|XMLHttpRequest|WebSocket|importScripts)\b", without_data)
    assert "default-src 'none'" in page


def test_everything_has_a_panel(page: str) -> None:
    for heading in (
        "The rig",
        "What the motion determined",
        "Clocks",
        "Reprojection residuals",
        "Two halves of the recording",
        "Cross-camera association between cameras",
        "Cross-camera association pictures",
        "Horizon",
        "Landmarks from camera to camera, enlarged",
        "IMU over time",
        "GNSS over time",
        "Motion of the rig",
        "Coverage of the images",
        "Masks",
        "Where this comes from",
        "From the initial guess to the result",
    ):
        assert f">{heading}</h" in page, heading
    assert "left out" not in page
    assert "harbour.bag" in page


def test_what_stands_behind_each_figure_is_said(page: str) -> None:
    assert "2,000 observations" in page  # the histogram's
    assert "Scatter of the residuals" in page
    assert "120 values" in page  # of 60 s
    assert "120 of 360 values" in page
    assert "rms 0.2" in page  # mrad, of the gyroscope
    assert "599 landmarks about the path" in page
    assert "of 5,000 in the adjustment, 600 are" in page
    scenes = json.loads(re.search(r'id="scenes">(.*?)</script>', page, re.DOTALL).group(1))
    assert sum(len(cloud["points"]) for cloud in scenes["paths"]["cloud"]) == 599
    assert scenes["paths"]["grid"]["x_names"][0].endswith(" m")
    assert scenes["rig"]["dimensions"] in page
    assert '<path class="cloud' in page


def test_halves_have_their_own_sigmas(page: str) -> None:
    row = re.search(r"<td>first</td>(.*?)</tr>", page, re.DOTALL).group(1)
    text = " ".join(re.sub("<[^>]*>", " ", row).split())
    assert text == "1000.0 ± 4.0 mm 500.0 ± 5.0 mm unobservable ± 0.030 °"


def test_landmarks_that_lie_wrong_are_marked(page: str) -> None:
    tiles = re.findall(r'<figure class="patch( bad)?">.*?</figure>', page, re.DOTALL)
    assert tiles == ["", " bad"]
    assert "6.00 px off <b>bad</b>" in page


@pytest.mark.parametrize("halves", [3, [None], [{"translation_m": [1, "x"]}], [{"std_rotation_deg": None}]])
def test_halves_of_any_shape_cost_no_report(tmp_path: Path, halves: object) -> None:
    checks = {"split_half": {"port": {"sigmas": 1.0, "halves": halves}}}
    save_calibration(replace(boat(), checks=checks), tmp_path / "calibration.yaml")
    assert "Two halves of the recording" in build_report(tmp_path).read_text()


def test_series_with_holes_are_not_drawn(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    with np.load(copy / "adjustment.npz") as arrays:
        changed = dict(arrays)
    changed["gnss_off"][3] = np.nan
    np.savez(copy / "adjustment.npz", **changed)
    assert "not all values of gnss_off are finite" in load_report_content(copy).absent["adjustment"]


def test_a_huge_adjustment_file_is_not_loaded(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    np.savez_compressed(copy / "adjustment.npz", gyro_bias=np.zeros((3_000_000, 3)))
    assert "too large" in load_report_content(copy).absent["adjustment"]


def test_svg_is_well_formed(page: str) -> None:
    drawings = re.findall(r'<svg class="(?:chart|map)".*?</svg>', page, re.DOTALL)
    assert len(drawings) >= 12
    for drawing in drawings:
        ET.fromstring(drawing)
        assert "nan" not in drawing


@pytest.mark.parametrize(
    "name",
    ["initial_rig.yaml", "trajectories", "tracks", "residuals.npz", "adjustment.npz", "masks", "pictures"],
)
def test_a_panel_without_its_file_says_so(folder: Path, tmp_path: Path, name: str) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    (copy / name).rename(tmp_path / "elsewhere")
    text = build_report(copy).read_text()
    assert f"{name}{'/pictures.json' if name == 'pictures' else ''} is not there" in text


def test_a_calibration_alone_is_enough(tmp_path: Path) -> None:
    save_calibration(boat(), tmp_path / "calibration.yaml")
    text = build_report(tmp_path).read_text()
    assert text.count("is not there") >= 6
    with pytest.raises(InputError, match=r"no calibration\.yaml"):
        build_report(tmp_path / "nowhere")


def damage(folder: Path, name: str) -> None:
    file = folder / name
    if name.endswith(".npz"):
        np.savez(file, camera=np.zeros(3, int), imu_turn=np.zeros((3, 3)))
    elif name.endswith(".json"):
        file.write_text(
            '[{"camera": "front", "file": "../calibration.yaml", "timestamp_ns": 1, "kind": "horizon"}]'
        )
    else:
        file.write_bytes(b"\x00 not what it says")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("residuals.npz", "residuals.npz cannot be read"),
        ("adjustment.npz", "adjustment.npz cannot be read"),
        ("tracks/front.npz", "front.npz cannot be read"),
        ("trajectories/front.tum", "front.tum"),
        ("masks/front.png", "front.png is not an image"),
        ("pictures/pictures.json", "outside its folder"),
        ("initial_rig.yaml", "initial_rig.yaml"),
    ],
)
def test_a_damaged_file_costs_its_panel_only(folder: Path, tmp_path: Path, name: str, words: str) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    damage(copy, name)
    content = load_report_content(copy)
    assert [reason for reason in content.absent.values() if words in reason], content.absent
    assert ">The rig</h2>" in build_report(content).read_text()


def test_pickled_arrays_are_not_loaded(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    with np.load(copy / "residuals.npz") as arrays:
        changed = dict(arrays)
    changed["camera_names"] = np.array(["front"], dtype=object)
    np.savez(copy / "residuals.npz", **changed)
    assert "allow_pickle" in load_report_content(copy).absent["residuals"]


def test_names_from_recordings_are_escaped(tmp_path: Path) -> None:
    evil = "</script><img src=x onerror=alert(1)>"
    rig = Calibration("imu", {evil: camera(evil, SE3.identity())}, provenance={evil: evil})
    save_calibration(rig, tmp_path / "calibration.yaml")
    write_residuals(tmp_path / "residuals.npz", [evil], circle(20), 500, np.random.default_rng(0))
    text = build_report(tmp_path).read_text()
    assert "<img src=x" not in text
    assert text.count("</script>") == 2
    scenes = re.search(r'id="scenes">(.*?)</script>', text, re.DOTALL).group(1)
    assert json.loads(scenes)["rig"]["cameras"][0]["name"] == evil


def test_what_is_not_determined_has_no_number(tmp_path: Path) -> None:
    height_m = 1.2345678
    rig = boat(checks=GOOD_CHECKS)
    port = rig.cameras["port"]
    moved = replace(port, rig_from_cam=SE3(port.rig_from_cam.rotation, np.array([0.41, 0.83, height_m])))
    save_calibration(
        without_vertical(replace(rig, cameras={**rig.cameras, "port": moved}), "port"),
        tmp_path / "calibration.yaml",
    )
    text = build_report(tmp_path).read_text()
    assert "unobservable" in text
    assert "Record where waves roll the boat." in text
    assert "1234.6" not in text
    assert "1.23457" not in text
    assert "nan" not in re.sub(r"[A-Za-z]+nan|nan[A-Za-z]+", "", text)
    forward, backward = directions(load_report_content(tmp_path).calibration.cameras["port"])
    assert [v.is_observable for v in forward.position] == [True, True, False]
    assert not any(v.is_observable for v in backward.position)
    assert forward.copies == backward.copies == ()
    assert all(v.is_observable for v in forward.angles)


def test_an_unknown_rotation_has_no_angles(tmp_path: Path) -> None:
    lost = UnobservableDirection(np.eye(6)[2], "heading of front")
    blind = CalibratedCamera("front", SE3.identity(), np.eye(6), (lost,))
    save_calibration(Calibration("imu", {"front": blind}), tmp_path / "calibration.yaml")
    assert "heading of front" in build_report(tmp_path).read_text()
    forward, _ = directions(blind)
    assert not any(v.is_observable for v in (*forward.angles, *forward.quat_wxyz))
    assert "unobservable" in looks(blind, "imu")


def test_sigmas_of_the_inverse_are_those_of_a_monte_carlo() -> None:
    one = boat().cameras["port"]
    rng = np.random.default_rng(1)
    drawn = one.rig_from_cam.retract(rng.multivariate_normal(np.zeros(6), one.covariance, 20000)).inverse()
    stated = [float(v.std.split()[1]) for v in directions(one)[1].position]
    np.testing.assert_allclose(1e3 * drawn.translation.std(axis=0), stated, rtol=0.07)  # two digits are shown


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({}, "good", "agree within 1.1 σ"),
        ({"hand_over": {"count": 9, "median_px": 7.5}}, "usable", "7.5 px off"),
        ({"hand_over": {"count": 0}}, "usable", "No landmark went"),
        (
            {
                "hand_over": {
                    "count": 92,
                    "median_px": 0.13,
                    "by_pair": {
                        "aft->port": {"count": 90, "median_px": 0.12},
                        "aft->mast": {"count": 2, "median_px": 3.1},
                    },
                }
            },
            "usable",
            "aft->mast 3.1 px",
        ),
        (
            {
                "hand_over": {
                    "count": 92,
                    "median_px": 0.13,
                    "by_pair": {
                        "aft->port": {"count": 90, "median_px": 0.12},
                        "aft->mast": {"count": 2, "median_px": 1.4},
                    },
                }
            },
            "good",
            "0.13 px off",
        ),
        (
            {"hand_over": {"count": 9, "median_px": 0.5, "by_pair": {"aft->aft": {"count": 9}}}},
            "usable",
            "No landmark went",
        ),
        ({"split_half": {"port": {"sigmas": 8.0}}}, "usable", "disagree by 8.0 σ for port"),
        ({"split_half": None}, "usable", "were not compared"),
        ({"failed_cameras": {"mast": "too few points"}}, "usable", "mast could not be calibrated"),
        ({"converged": False}, "usable", "did not settle"),
    ],
)
def test_the_verdict_rests_on_checks(change: dict, level: str, words: str) -> None:
    verdict = judge(boat(checks={**GOOD_CHECKS, **change}))
    assert verdict.level == level
    assert any(words in reason.words for reason in verdict.reasons)
    assert all(reason.remedy for reason in verdict.reasons if not reason.holds)


def test_an_imprecise_calibration_is_usable_only() -> None:
    rig = boat(checks=GOOD_CHECKS)
    wide = {name: replace(c, covariance=100 * c.covariance) for name, c in rig.cameras.items()}
    verdict = judge(replace(rig, cameras=wide))
    assert verdict.level == "usable"
    assert sum("good means at most" in reason.words for reason in verdict.reasons) == 2
    assert judge(without_vertical(rig, "aft")).level == "unobservable"
    unknown = {name: replace(c, covariance=np.full((6, 6), np.nan)) for name, c in rig.cameras.items()}
    assert judge(replace(rig, cameras=unknown)).level == "usable"


def test_the_summary_is_short_and_says_the_same() -> None:
    lines = summary_lines(boat(checks=GOOD_CHECKS))
    assert lines[0].startswith("GOOD")
    assert len(lines) <= 10
    assert any("88.0° left of x, 15.0° down" in line for line in lines)
    assert len(summary_lines(many_cameras(12))) <= 13


def test_motion_figures_are_those_of_the_motion() -> None:
    motion = motion_of(circle(60.0))
    assert motion.yaw_span_deg == pytest.approx(360, abs=3)
    assert motion.roll_std_deg == pytest.approx(np.rad2deg(0.03) / np.sqrt(2), rel=0.1)
    assert motion.path_m == pytest.approx(159, abs=3)
    assert np.nanmedian(motion.speed) == pytest.approx(159 / 60, rel=0.1)


def test_paths_of_other_worlds_are_laid_over_each_other() -> None:
    rig = circle(60.0)
    moved = SE3.exp(np.array([0.1, 0.4, 2.0, 5, 6, 7]))
    world = moved * rig.world_from_body
    scaled = replace(
        rig, name="cam", world_from_body=SE3(world.rotation, 0.3 * world.translation), is_metric=False
    )
    paths = paths_in_one_world({"rig": rig, "cam": scaled}, "rig")
    np.testing.assert_allclose(paths["cam"], paths["rig"], atol=1e-6)


def test_reduction_finds_what_was_put_in(folder: Path) -> None:
    content = load_report_content(folder)
    front = content.residuals["front"]
    with np.load(folder / "residuals.npz") as arrays:
        mine = arrays["camera"] == 0
        size = np.linalg.norm(arrays["residuals_px"][mine], axis=1)
        pixels = arrays["pixels"][mine]
    assert front.count == 2000
    assert front.median_px == pytest.approx(float(np.median(size)))
    assert front.image.counts.sum() == 2000
    cell = (pixels[:, 0] + 0.5 < 640 / 24) & (pixels[:, 1] + 0.5 < 480 / 18)
    assert front.image.counts[0, 0] == cell.sum()
    assert front.over_angle.counts.sum() <= 2000
    assert content.tracks["port"].report["frames_black"] == 1


def test_ticks_are_round_and_inside() -> None:
    assert ticks(0, 10) == [0, 2, 4, 6, 8, 10]
    assert ticks(-0.31, 0.29, 3) == pytest.approx([-0.2, 0, 0.2])
    assert ticks(5, 5) == [5]


def test_a_chart_breaks_its_line_where_there_is_no_number() -> None:
    x = np.arange(6.0)
    y = np.array([1, 2, np.nan, 4, np.nan, 5])
    drawing = line_chart("t", "x <", "y", [Series("s", x, y)])
    assert drawing.count("<polyline") == 1
    assert drawing.count("<circle") == 2
    assert "x &lt;" in drawing
    assert line_chart("t", "x", "y", [Series("s", x, np.full(6, np.nan))]) == ""


@pytest.mark.parametrize("file_format", ["png", "svg"])
def test_figures_for_papers(folder: Path, tmp_path: Path, file_format: str) -> None:
    files = write_figures(load_report_content(folder), tmp_path, file_format)
    names = ["rig", "paths", "residuals_angle", "residuals_time", "sigmas"]
    assert [f.stem for f in files] == names
    for file in files:
        if file_format == "png":
            image = cv2.imread(str(file))
            assert image.shape[1] == pytest.approx(1050, abs=2)
            assert image.std() > 5
        else:
            assert ET.parse(file).getroot().tag.endswith("svg")


def test_the_verb_rebuilds_the_page(folder: Path, tmp_path: Path) -> None:
    (folder / "report.html").unlink(missing_ok=True)
    done = CliRunner().invoke(build_app(), ["report", str(folder), "--figures", str(tmp_path / "figures")])
    assert done.exit_code == 0, done.output
    assert "GOOD" in done.output
    assert (folder / "report.html").is_file()
    assert len(list((tmp_path / "figures").iterdir())) == 5


def test_the_head_says_which_recording_and_how_long(folder: Path) -> None:
    page = render(load_report_content(folder))
    assert "harbour.bag" in page.partition("</header>")[0]
    assert "Observations behind each point" in page
    assert "Intrinsics used" in page


def test_rerun_recording(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    done = CliRunner().invoke(build_app(), ["report", str(folder), "--rrd", str(tmp_path / "rig.rrd")])
    assert done.exit_code == 0, done.output
    content = (tmp_path / "rig.rrd").read_bytes()
    assert content[:3] == b"RRF"
    for entity in (
        b"/world/rig/front/image",
        b"/world/rig/front/image/predicted",
        b"/world/rig/port",
        b"/world/rig/sigma/port",
        b"/world/path",
        b"/world/landmarks",
        b"/residuals_px/aft",
    ):
        assert entity in content, entity


def test_a_viewer_that_cannot_start_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = pytest.importorskip("rerun", reason="the extra `rerun` is not installed")
    content = load_report_content(folder)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform == "linux":
        with pytest.raises(UsageError, match="no display"):
            log_to_rerun(content, None, view=True)

    def fail(stream: object) -> None:
        raise RuntimeError("Failed to find Rerun Viewer executable in PATH.\n\nYou can install ...")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun.RecordingStream, "spawn", fail)
    with pytest.raises(UsageError, match=r"did not start: Failed to find .*PATH\. Write") as caught:
        log_to_rerun(content, None, view=True)
    assert "--rrd" in caught.value.remedy


def test_the_first_guess_is_compared_in_its_own_frame(tmp_path: Path) -> None:
    rig = boat()
    front = rig.cameras["front"].rig_from_cam
    in_front = {n: replace(c, rig_from_cam=front.inverse() * c.rig_from_cam) for n, c in rig.cameras.items()}
    save_calibration(rig, tmp_path / "calibration.yaml")
    save_calibration(replace(rig, reference="front", cameras=in_front), tmp_path / "initial_rig.yaml")
    text = build_report(tmp_path).read_text()
    assert "Positions in the frame of front." in text
    steps = re.findall(r"<td>(−?\d+) → (−?\d+)</td>", text)
    assert len(steps) == 3 * len(rig.cameras)
    assert all(before == after for before, after in steps)


@pytest.mark.parametrize(
    ("std", "words"), [(0.0174, "0.017"), (4.0, "4.0"), (52.4, "52"), (131.0, "131"), (0.0, "0.0")]
)
def test_deviations_have_two_digits(std: float, words: str) -> None:
    assert two_digits(std) == words


@pytest.mark.slow
def test_twelve_cameras_half_an_hour(tmp_path: Path) -> None:
    rig = many_cameras(12)
    write_folder(tmp_path, rig, 1800.0, 300_000, pictures_per_camera=4)
    first, *others = (tmp_path / "tracks" / f"{name}.npz" for name in rig.cameras)
    write_tracks(first, first.stem, circle(1800.0).timestamps_ns, 1_500_000, np.random.default_rng(1))
    for other in others:
        shutil.copyfile(first, other)
    start = time.process_time()
    path = build_report(tmp_path)
    seconds = time.process_time() - start
    print(f"12 cameras, 30 min: {path.stat().st_size / 1e6:.1f} MB, {seconds:.1f} CPU-s")
    assert path.stat().st_size < 15e6
    assert seconds < 30
    pictures = sum(len(uri) for uri in re.findall(r"data:image/jpeg;base64,[^\"]*", path.read_text()))
    assert pictures <= 1.02 * BUDGET_BYTES
