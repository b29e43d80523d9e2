"""The own hull in a camera's picture: how the camera turned against it, at standstill, with other light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.errors import InputError
from rigwake.geometry import so3
from rigwake.geometry.se3 import SE3
from rigwake.monitor.hull_edges import HullCue, hull_cues
from rigwake.monitor.run import CameraVerdict, with_hull
from rigwake.monitor.states import CameraState
from rigwake.monitor.thresholds import Thresholds
from rigwake.recording import CameraStream, Frame
from rigwake.tracking.hull_picture import (
    HullPicture,
    load_hull_picture,
    load_hull_pictures,
    mean_picture,
    save_hull_picture,
)
from rigwake.tracking.masks import CameraMask, pixel_grid

WIDTH, HEIGHT = 320, 240
LENS = KannalaBrandt4((88.0, 88.3, 159.4, 120.2, 0.02, -0.01, 0.003, -0.0005), WIDTH, HEIGHT)
MOUNTING = SE3(so3.exp(np.array([0.3, -1.1, 0.7])), np.zeros(3))
DECK = np.zeros((HEIGHT, WIDTH), dtype=bool)
DECK[HEIGHT * 2 // 3 :] = True


@cache
def deck_picture(seed: int = 0) -> np.ndarray:
    """Planks, lines and fittings."""
    rng = np.random.default_rng(seed)
    picture = np.full((HEIGHT, WIDTH), 120.0, np.float32)
    for _ in range(80):
        centre = (int(rng.integers(0, WIDTH)), int(rng.integers(HEIGHT // 2, HEIGHT)))
        size = (int(rng.integers(4, 25)), int(rng.integers(3, 12)))
        cv2.ellipse(
            picture, centre, size, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(40, 220)), -1
        )
    return cv2.GaussianBlur(picture, (0, 0), 1.0)


@dataclass(frozen=True, eq=False)
class DeckFrames:
    """A deck that stands still before noise that does not; from `first` on the camera is turned (camera axes)."""

    turn: np.ndarray
    first: int = 0
    light: float = 1.0
    person: bool = False

    def frames(self, indices: Sequence[int] | np.ndarray, *, colour: bool = False) -> Iterator[Frame]:
        deck = np.where(DECK, deck_picture(), 0.0).astype(np.float32)
        solid = DECK.astype(np.float32)
        bearings, _ = LENS.unproject(pixel_grid(WIDTH, HEIGHT))
        pixels, _ = LENS.project(np.nan_to_num(bearings, nan=1.0) @ so3.exp(self.turn).T)
        maps = pixels.astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        for index in map(int, indices):
            rng = np.random.default_rng(index)
            scene = cv2.resize(rng.uniform(60, 200, (30, 40)).astype(np.float32), (WIDTH, HEIGHT))
            shown, here = deck * self.light, solid
            if index >= self.first:
                shown, here = (cv2.remap(image, maps, None, cv2.INTER_CUBIC) for image in (shown, here))
            image = here * shown + (1 - here) * scene + rng.normal(0, 3, scene.shape)
            if self.person:
                cv2.circle(image, (60, 200), 18, 20.0, -1)
            yield Frame(index, index * 500_000_000, np.clip(image, 0, 255).astype(np.uint8))


def camera(turn_deg: Sequence[float] = (0, 0, 0), **kwargs: object) -> CameraStream:
    stamps = np.arange(60) * 500_000_000  # half a minute
    frames = DeckFrames(np.deg2rad(np.array(turn_deg, dtype=float)), **kwargs)  # type: ignore[arg-type]
    return CameraStream("front", stamps, frames, WIDTH, HEIGHT, LENS)


@cache
def kept_picture() -> HullPicture:
    picture = mean_picture(camera(), np.arange(0, 60, 3))
    assert picture is not None
    return HullPicture(picture, DECK, "kept")


def cue_of(stream: CameraStream, kept: HullPicture | None = None) -> HullCue:
    cues = hull_cues(
        {"front": stream}, {"front": MOUNTING}, {"front": 0.0}, (0, 30 * 10**9), {"front": kept or kept_picture()},
        Thresholds(),
    )  # fmt: skip
    return cues["front"]


def test_a_hull_that_is_where_it_was() -> None:
    cue = cue_of(camera())
    assert not cue.moved
    assert cue.rotation is not None
    assert np.rad2deg(np.linalg.norm(cue.rotation)) < 0.03
    assert "where it was" in cue.words


@pytest.mark.parametrize("turn_deg", [(0.3, 0.0, 0.0), (0.1, 0.2, -0.2), (0.0, 0.0, 2.0)])
def test_a_camera_that_turned_at_standstill(turn_deg: tuple[float, float, float]) -> None:
    """Size and axis, in the axes of the rig, and when."""
    cue = cue_of(camera(turn_deg, first=30))
    assert cue.moved
    assert cue.since_ns == 15 * 10**9
    assert cue.rotation is not None
    assert cue.covariance is not None
    expected = MOUNTING.rotation @ np.deg2rad(turn_deg)
    error = cue.rotation - expected
    assert np.rad2deg(np.linalg.norm(error)) < 0.03
    assert error @ np.linalg.solve(cue.covariance, error) < 16


def test_light_and_a_person_on_deck_are_no_change() -> None:
    assert not cue_of(camera(light=0.6)).moved
    assert not cue_of(camera(person=True)).moved
    dark = cue_of(camera(light=0.02))
    assert not dark.moved
    assert "cannot be compared" in dark.words


def test_another_deck_cannot_be_compared_and_none_says_nothing() -> None:
    other = HullPicture(np.where(DECK, deck_picture(5), 100.0).astype(np.float32), DECK, "kept")
    cue = cue_of(camera(), other)
    assert not cue.moved
    assert "looks different" in cue.words
    bare = HullPicture(np.full((HEIGHT, WIDTH), 90.0, np.float32), DECK, "kept")
    assert "too little" in cue_of(camera(), bare).words
    small = HullPicture(np.zeros((10, 10), np.float32), np.ones((10, 10), bool), "kept")
    assert "another size" in cue_of(camera(), small).words


def test_what_is_kept_is_read_back(tmp_path: Path) -> None:
    stream = camera()
    assert load_hull_picture(tmp_path, "front") is None
    masks = tmp_path / "masks"
    masks.mkdir()
    CameraMask(WIDTH, HEIGHT).with_region("hull", DECK).save(masks, "front")
    save_hull_picture(stream, masks)
    kept = load_hull_pictures(tmp_path, ["front", "left"])
    assert list(kept) == ["front"]
    assert list(load_hull_pictures(tmp_path / "calibration.yaml", ["front", "left"])) == ["front"]
    assert np.abs(kept["front"].picture[DECK] - kept_picture().picture[DECK]).max() < 8
    np.testing.assert_array_equal(kept["front"].region, DECK)
    assert not cue_of(stream, kept["front"]).moved
    (masks / "front_mean.png").write_bytes(b"not a picture")
    with pytest.raises(InputError, match="not a grey picture"):
        load_hull_picture(masks, "front")
    cv2.imwrite(str(masks / "front_mean.png"), np.zeros((4, 4), np.uint16))
    with pytest.raises(InputError, match="do not belong together"):
        load_hull_picture(masks, "front")


def test_what_the_hull_adds_to_the_verdict() -> None:
    """It blames where the motion cannot tell, it does not overrule the motion, and it never says OK by itself."""
    moved, still = cue_of(camera((0.3, 0, 0))), cue_of(camera())
    before = CameraVerdict("front", CameraState.UNOBSERVABLE, np.full(3, np.inf), "about the vertical")
    turned = np.eye(3)[[1, 2, 0]]
    after, notes = with_hull({"front": before}, {"front": moved}, turned)
    assert after["front"].state is CameraState.DRIFTED
    assert after["front"].size_deg == pytest.approx(0.3, abs=0.03)
    assert after["front"].rotation is not None
    np.testing.assert_allclose(after["front"].rotation, turned @ moved.rotation)
    assert not notes
    after, notes = with_hull({"front": before}, {"front": still}, turned)
    assert after["front"].state is CameraState.UNOBSERVABLE
    assert "where it was" in notes[0]
    ok = replace(before, state=CameraState.OK)
    after, notes = with_hull({"front": ok}, {"front": moved}, turned)
    assert after["front"].state is CameraState.OK
    assert "something on deck" in notes[0]
