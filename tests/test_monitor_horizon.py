"""The horizon between cameras: its line in pictures, and what differences of lines say of the cameras."""

from __future__ import annotations

import numpy as np
import pytest

from rigwake.cameras.models.kannala_brandt import KannalaBrandt4
from rigwake.geometry import so3
from rigwake.monitor.cues import HORIZON, CueSeries, cue_series, horizon_suspects
from rigwake.monitor.horizon_cue import SLOTS_PER_BLOCK, HorizonSightings, score_horizon
from rigwake.monitor.horizon_line import HorizonSearch, level_axes
from rigwake.monitor.innovations import Belief
from rigwake.monitor.score import _nothing
from rigwake.monitor.thresholds import Thresholds
from rigwake.tracking.masks import pixel_grid

LENS = KannalaBrandt4((150.6, 150.7, 160.9, 118.7, -0.011, 0.006, -0.0034, 0.0005), 320, 240)
CAMERAS = ("front", "left", "back", "right")
AZIMUTH_DEG = (0.0, 90.0, 180.0, -90.0)
BELIEF = Belief(np.zeros(28), np.diag(np.tile([2e-4] * 3 + [5e-3] * 3 + [1e-4], 4) ** 2))


def mounted(azimuth_deg: float, tilt_deg: float = -8.0) -> np.ndarray:
    """rig_from_cam of a camera that looks to an azimuth and down by a tilt."""
    level = so3.exp(np.array([0.0, 0.0, np.deg2rad(azimuth_deg)]))
    optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return level @ so3.exp(np.array([0.0, -np.deg2rad(tilt_deg), 0.0])) @ optical


def picture(
    rotation: np.ndarray, up: np.ndarray, *, light: float = 1.0, shore_deg: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Sky over dark waves; shore_deg: how high hills stand above the horizon."""
    bearings, valid = LENS.unproject(pixel_grid(LENS.width_px, LENS.height_px))
    there = np.nan_to_num(bearings) @ rotation.T
    elevation = np.rad2deg(np.arcsin(np.clip(there @ up, -1, 1)))
    ahead, side = level_axes(rotation, up)
    azimuth = np.arctan2(there @ side, there @ ahead)
    hills = shore_deg * (1 + np.sin(9 * azimuth) + 0.5 * np.sin(23 * azimuth))
    rng = np.random.default_rng(seed)
    water = 90 + 12 * rng.standard_normal(len(there))
    grey = water + (170 - water) / (1 + np.exp(-(elevation - hills) / 0.12))
    grey = np.where(valid, grey, 0.0) * light + rng.normal(0, 2, len(there))
    return np.clip(grey, 0, 255).astype(np.uint8).reshape(LENS.height_px, LENS.width_px)


def test_the_line_tells_how_a_camera_is_turned() -> None:
    """Drawn with the true mounting, looked for with another and an attitude that is off."""
    rng = np.random.default_rng(1)
    for azimuth in AZIMUTH_DEG:
        believed, up = mounted(azimuth), np.array([0.03, -0.04, 1.0])
        up /= np.linalg.norm(up)
        turn, wrong = np.deg2rad(rng.normal(0, 0.4, 3)), np.deg2rad(rng.normal(0, 0.4, 3))
        supposed = so3.exp(wrong) @ up
        line = HorizonSearch(LENS, believed).find(picture(so3.exp(turn) @ believed, up), supposed)
        assert line is not None
        ahead, side = level_axes(believed, supposed)
        off = up - supposed
        expected = [turn @ side - off @ ahead, -turn @ ahead - off @ side]
        np.testing.assert_allclose(
            np.rad2deg([line.ahead, line.side]), np.rad2deg(expected), atol=0.06
        )  # 0.15 px


@pytest.mark.parametrize("what", [{"light": 0.1}, {"shore_deg": 1.0}])
def test_night_and_hills_are_no_horizon(what: dict[str, float]) -> None:
    up = np.array([0.0, 0.0, 1.0])
    assert HorizonSearch(LENS, mounted(0.0)).find(picture(mounted(0.0), up, **what), up) is None


def test_the_own_hull_is_left_out() -> None:
    up = np.array([0.0, 0.0, 1.0])
    shown = picture(mounted(0.0), up)
    hull = np.zeros(shown.shape, dtype=bool)
    hull[60:, 100:150] = True
    shown[hull] = 250
    line = HorizonSearch(LENS, mounted(0.0), hull).find(shown, up)
    assert line is not None
    assert np.rad2deg(abs(line.ahead)) < 0.04


def sightings(
    blocks: int,
    rng: np.random.Generator,
    *,
    turned: np.ndarray | None = None,
    since: int = 14,
    trim_deg: float = 0.0,
    shore_deg: float = 0.0,
    cameras: int = 4,
) -> HorizonSightings:
    """Lines of all cameras while the attitude is off by some tenths of a degree.

    turned: (3,) of `left`, radians, from block `since` on. trim_deg: by how much the level is off from then on.
    shore_deg: by how much the line of `left` wanders from block to block.
    """
    slots = blocks * SLOTS_PER_BLOCK
    level_off = np.deg2rad(np.cumsum(rng.normal(0, 0.05, (slots, 2)), axis=0))
    level_off[since * SLOTS_PER_BLOCK :, 0] += np.deg2rad(trim_deg)
    shore = np.deg2rad(np.cumsum(rng.normal(0, shore_deg, blocks)).repeat(SLOTS_PER_BLOCK))
    parts = []
    for slot in range(slots):
        up = np.array([*(0.02 * np.sin([0.8 * slot, 0.9 * slot])), 1.0])
        up /= np.linalg.norm(up)
        for k in range(cameras):
            ahead, side = level_axes(mounted(AZIMUTH_DEG[k]), up)
            turn = (
                turned if turned is not None and k == 1 and slot >= since * SLOTS_PER_BLOCK else np.zeros(3)
            )
            off = np.array([*level_off[slot], 0.0])
            line = np.array([turn @ side - off @ ahead, -turn @ ahead - off @ side])
            line += np.deg2rad([0.02 * k, -0.03 * k]) + rng.normal(0, np.deg2rad(0.03), 2)
            line[0] += shore[slot] if k == 1 else 0.0
            parts.append((k, slot, line, np.full(2, np.deg2rad(0.02)), ahead, side))
    return HorizonSightings(*(np.array(column) for column in zip(*parts, strict=True)))


def cue(found: HorizonSightings, blocks: int, cameras: int = 4) -> CueSeries:
    """The cue's own statistic."""
    empty = _nothing(CAMERAS[:cameras], np.arange(blocks) * 10**10)
    belief = Belief(BELIEF.mean[: 7 * cameras], BELIEF.covariance[: 7 * cameras, : 7 * cameras])
    scores = score_horizon(found, empty)
    return cue_series({"ego-motion": empty, HORIZON: scores}, belief, Thresholds())[HORIZON]


def test_a_camera_that_turned_differs_from_the_others() -> None:
    for axis in (0, 1):
        turned = np.deg2rad(0.3) * np.eye(3)[axis]
        series = cue(sightings(24, np.random.default_rng(axis), turned=turned), 24)
        assert series.value[:14].max() < Thresholds().suspect
        assert series.value[16].argmax() == 1
        assert series.value[17, 1] > Thresholds().alarm


def test_about_the_vertical_it_sees_nothing() -> None:
    turned = np.deg2rad([0.0, 0.0, 2.0])
    series = cue(sightings(24, np.random.default_rng(5), turned=turned), 24)
    assert series.value.max() < Thresholds().suspect
    assert (series.std_deg[-1, :, 2] > 0.5).all()  # what waves tilt it by


def test_trim_and_shores_turn_no_camera() -> None:
    """The trim moves all lines alike; a shore wanders, and its scatter is learnt."""
    for what in ({"trim_deg": 1.0}, {"shore_deg": 0.1}, {}):
        series = cue(sightings(24, np.random.default_rng(1), **what), 24)
        assert series.value.max() < Thresholds().suspect, what


def test_standing_it_makes_one_camera_suspect_and_none_drifted() -> None:
    """Where the motion tells nothing: half a degree of one camera for half a minute, but not another trim."""
    empty = _nothing(CAMERAS, np.arange(24) * 10**10)
    turned = np.deg2rad([0.3, 0.4, 0.0])
    series = cue(sightings(24, np.random.default_rng(1), turned=turned), 24)
    assert list(horizon_suspects(series, empty, Thresholds())) == ["left"]
    quiet = cue(sightings(20, np.random.default_rng(1), trim_deg=1.0), 20)
    assert not horizon_suspects(quiet, empty.take(slice(0, 20)), Thresholds())


def test_one_camera_alone_says_nothing() -> None:
    found = sightings(6, np.random.default_rng(0), cameras=1)
    series = cue(found, 6, cameras=1)
    assert not series.value.any()
    assert series.words == "horizon: saw nothing"
