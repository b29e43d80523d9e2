"""`rigwake surround`: what a person gets, for good input and bad."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from rigwake.cli.main import build_app
from rigwake.errors import InputError, RigwakeError, UsageError
from rigwake.recording import CameraStream, Frame, Recording
from rigwake.views.depth.depth_panorama import MATCHED
from rigwake.views.frames import FrameWatch, frame_sets, require_fit
from view_scenes import HEIGHT_M, PLACES, attitude, four_cameras, photograph, water_and_ring, write_rig

RIG = four_cameras()
PERIOD = 10**8


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig.yaml and a folder with one picture per camera."""
    folder = tmp_path_factory.mktemp("scene")
    images = photograph(RIG, attitude(), water_and_ring(12.0))
    (folder / "pictures").mkdir()
    for name, image in images.items():
        cv2.imwrite(str(folder / "pictures" / f"{name}.png"), image)
    write_rig(folder / "rig.yaml")
    return folder


def surround(*arguments: object) -> tuple[str, RigwakeError | None]:
    result = CliRunner().invoke(build_app(), ["surround", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, RigwakeError | SystemExit):
        raise result.exception
    return result.output, result.exception if isinstance(result.exception, RigwakeError) else None


@pytest.mark.slow
def test_folder_gets_every_view_and_a_seam_report(scene: Path, tmp_path: Path) -> None:
    words, error = surround(
        scene / "rig.yaml", scene / "pictures", "-o", tmp_path / "out", "--height-m", HEIGHT_M, "--shell-m", 12,
        "--stabilise", "off",
    )  # fmt: skip
    assert error is None
    made = {p.name for p in (tmp_path / "out").iterdir()}
    assert made == {"panorama.jpg", "cylinder.jpg", "topdown.png", "bowl.jpg", "seams.html", "seams.json"}
    panorama = (tmp_path / "out" / "panorama.jpg").read_bytes()
    assert b"GPano:UsePanoramaViewer>True" in panorama
    assert b"GPano" not in (tmp_path / "out" / "bowl.jpg").read_bytes()
    report = json.loads((tmp_path / "out" / "seams.json").read_text())
    assert len(report["seams"]) == 4
    for seam in report["seams"]:
        assert seam["misalignment_px"] < 1.5  # the ring stands at the shell
        assert abs(seam["median_range_m"] - 12) < 1.0
        assert seam["colour_difference"] < 3
    assert not any(camera["is_to_blame"] for camera in report["cameras"])
    assert report["blind_sectors_deg"] == []
    assert words.count(" px at 12 m, colours") == 4
    assert "no blind sector" in words
    assert "next:" in words
    page = (tmp_path / "out" / "seams.html").read_text()
    assert "front|left" in page
    assert "http" not in page.replace("http-equiv", "")


def test_views_sizes_and_times(scene: Path, tmp_path: Path) -> None:
    for view, size in (
        ("cylinder", "320x96"),
        ("camera", "160x120"),
        ("bowl", "160x120"),
        ("topdown", "200x100"),
    ):
        words, error = surround(
            scene / "rig.yaml", scene / "pictures", "-o", tmp_path / f"{view}.png", "--view", view, "--size", size,
            "--height-m", 1.9, "--stabilise", "off", "--at", 0,
        )  # fmt: skip
        assert error is None, words
        picture = cv2.imread(str(tmp_path / f"{view}.png"))
        assert f"{picture.shape[1]}x{picture.shape[0]}" == size
        assert picture.std() > 10


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "x.gif"], "x.gif"),
        (["-o", "x.png", "--view", "sphere"], "sphere"),
        (["-o", "x.png", "--size", "10"], "--size"),
        (["-o", "x.png", "--size", "99999x10"], "--size"),
        (["-o", "x.png", "--size", "axb"], "--size"),
        (["-o", "x.png", "--at", "1000"], "outside"),
        (["-o", "x.png", "--height-m", "-3"], "height"),
        (["-o", "x.png", "--fov", "500"], "--fov"),
        (["-o", "x.png", "--stabilise", "gyro"], "stabilise"),
        ([], "Nothing to write"),
        (["-o", "x.png", "--from", "front=/dev/video0"], "--serve"),
        (["9000", "-o", "x.png"], "port"),
    ],
)
def test_wrong_usage_is_said(
    scene: Path, tmp_path: Path, monkeypatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    _, error = surround(scene / "rig.yaml", scene / "pictures", *arguments)
    assert isinstance(error, UsageError)
    assert words in str(error)
    assert not list(tmp_path.iterdir())


def test_calibration_of_another_vessel_shows_both_tables(scene: Path, tmp_path: Path) -> None:
    write_rig(tmp_path / "names.yaml", {"front": "bow"})
    write_rig(tmp_path / "size.yaml", width=800)
    for file, words in (("names.yaml", "bow"), ("size.yaml", "800 x 480")):
        recording = recording_of({n: blank() for n in RIG.names})
        from rigwake.views.rig_sources import read_rig_source
        from rigwake.views.surround_rig import surround_rig

        with pytest.raises(UsageError, match="does not fit the recording") as caught:
            require_fit(surround_rig(read_rig_source(tmp_path / file).rig), recording)
        assert words in str(caught.value)
        assert "calibration:" in str(caught.value)
        assert "recording:" in str(caught.value)


@pytest.mark.slow
def test_height_that_nobody_knows_is_asked_for(scene: Path, tmp_path: Path) -> None:
    flat = tmp_path / "flat"
    flat.mkdir()
    for name in RIG.names:
        cv2.imwrite(str(flat / f"{name}.png"), np.full((480, 640, 3), 90, np.uint8))
    _, error = surround(scene / "rig.yaml", flat, "-o", tmp_path / "x.png", "--view", "topdown")
    assert isinstance(error, UsageError)
    assert "--height-m" in str(error)
    words, error = surround(scene / "rig.yaml", flat, "-o", tmp_path / "x.png", "--size", "256x128")
    assert error is None
    assert "not known" in words
    _, error = surround(tmp_path / "nothing.yaml", flat, "-o", tmp_path / "y.png")
    assert isinstance(error, InputError)


def blank(count: int = 8, value: int = 120) -> list[np.ndarray]:
    rng = np.random.default_rng(value)
    return [np.clip(rng.normal(value, 20, (480, 640)), 0, 255).astype(np.uint8) for _ in range(count)]


@dataclass(frozen=True, eq=False)
class ImageFrames:
    """Pictures held in memory, as a frame source."""

    images: tuple[np.ndarray, ...]
    timestamps_ns: np.ndarray

    def frames(self, indices: Sequence[int] | np.ndarray, *, colour: bool = False) -> Iterator[Frame]:
        """See `FrameSource.frames`."""
        for index in indices:
            image = self.images[int(index)]
            if not colour and image.ndim == 3:
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            yield Frame(int(index), int(self.timestamps_ns[index]), image)


def recording_of(images: dict[str, list[np.ndarray]], shift_ns: dict[str, int] | None = None) -> Recording:
    cameras = {}
    for name, pictures in images.items():
        stamps = np.arange(len(pictures), dtype=np.int64) * PERIOD + (shift_ns or {}).get(name, 0)
        source = ImageFrames(tuple(pictures), stamps)
        cameras[name] = CameraStream(name, stamps, source, 640, 480)
    return Recording(Path("made-up"), "test", cameras)


def last_set(images: dict[str, list[np.ndarray]], shift_ns: dict[str, int] | None = None):
    streams = require_fit(RIG, recording_of(images, shift_ns))
    return list(frame_sets(streams, RIG, np.arange(6) * PERIOD))


def test_faulty_cameras_are_left_out_and_the_rest_goes_on() -> None:
    good = {name: blank(value=90 + 10 * k) for k, name in enumerate(RIG.names)}
    assert not last_set(good)[-1].missing
    black = last_set(good | {"left": [np.zeros((480, 640), np.uint8)] * 8})[-1]
    assert black.missing == {"left": "black"}
    frozen = last_set(good | {"back": [good["back"][0]] * 8})
    assert not frozen[0].missing
    assert frozen[-1].missing == {"back": "frozen"}
    gone = last_set({n: good[n] for n in RIG.names if n != "right"})[-1]
    assert gone.missing == {"right": "not in the recording"}
    late = last_set(good, {"front": 30 * PERIOD})[-1]
    assert "late by" in late.missing["front"]
    stopped = last_set(good | {"front": good["front"][:2]})[-1]
    assert "early by" in stopped.missing["front"]
    assert not stopped.stack[0].any()


def test_frames_are_paired_by_corrected_time() -> None:
    good = {name: blank(value=90 + 10 * k) for k, name in enumerate(RIG.names)}
    sets = last_set(good, {"left": 2 * 10**7})
    assert not sets[2].missing
    assert sets[2].offsets_s[1] == pytest.approx(0.02)
    assert sets[2].offsets_s[0] == 0


def test_pictures_that_change_their_size_are_refused_by_name() -> None:
    good = {name: blank() for name in RIG.names}
    good["left"][4] = np.full((240, 320), 99, np.uint8)
    with pytest.raises(InputError, match="left: a picture is 320 x 240"):
        last_set(good)


def test_frozen_needs_new_stamps() -> None:
    watch, image = FrameWatch(), blank(1)[0]
    assert [watch.fault(image, 7) for _ in range(5)] == [""] * 5  # asked for again, not frozen
    assert [watch.fault(image, 8 + k) for k in range(3)][-1] == "frozen"


@pytest.mark.slow
def test_video_of_a_recording_with_a_bad_camera(scene: Path, tmp_path: Path) -> None:
    """A folder of pictures per camera, one of them black: the video is made, and says so."""
    recording = tmp_path / "sail"
    names = list(PLACES)
    for name in names:
        (recording / name).mkdir(parents=True)
        image = cv2.imread(str(scene / "pictures" / f"{name}.png"))
        for k in range(5):
            picture = np.zeros_like(image) if name == "back" else np.roll(image, k, axis=1)
            cv2.imwrite(str(recording / name / f"{10**18 + k * PERIOD}.jpg"), picture)
    words, error = surround(
        scene / "rig.yaml", recording, "-o", tmp_path / "x.mp4", "--size", "512x256", "--height-m", 1.9,
        "--stabilise", "off",
    )  # fmt: skip
    assert error is None, words
    with av.open(str(tmp_path / "x.mp4")) as video:
        frames = [f.to_ndarray(format="bgr24") for f in video.decode(video=0)]
    assert len(frames) == 5
    assert frames[0][110:150].std() > 10
    for name in names:
        for file in (recording / name).iterdir():
            cv2.imwrite(str(file), np.zeros((480, 640, 3), np.uint8))
    _, error = surround(scene / "rig.yaml", recording, "-o", tmp_path / "y.mp4", "--height-m", 1.9)
    assert isinstance(error, InputError)
    assert error.exit_code == 1
    assert not (tmp_path / "y.mp4").exists()


@pytest.mark.slow
def test_depth_pair_by_pair_and_all_around(scene: Path, tmp_path: Path) -> None:
    """Both find the ring; the pictures are a folder without a way, so nothing earlier is looked at."""
    for words in ([], ["--sweep"]):
        out = tmp_path / ("swept" if words else "paired")
        arguments = [
            "depth",
            scene / "rig.yaml",
            scene / "pictures",
            "-o",
            out,
            "--height-m",
            HEIGHT_M,
            *words,
        ]
        result = CliRunner().invoke(build_app(), list(map(str, arguments)))
        assert result.exit_code == 0, result.output
        (file,) = out.glob("*.npz")
        with np.load(file) as found:
            matched = found["range_m"][found["source"] == MATCHED]
        assert len(matched) > 1000
        assert np.median(np.abs(matched / 12.0 - 1)) < 0.1
