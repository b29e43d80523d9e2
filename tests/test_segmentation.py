"""Labels: the shipped network, external networks, measures, and real frames."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from onnx_files import constant_network, one_layer
from rigwake.cli.main import build_app
from rigwake.errors import EstimationError, InputError, UsageError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.scene.colour_method import ColourClassifier
from rigwake.views.scene.label_measures import LabelComparison, flat_horizon, water_edge_rows
from rigwake.views.scene.network import external_network, network_input, shipped_network
from rigwake.views.scene.segmentation import SmoothedLabels, segment_image, segment_strip, turned_columns
from rigwake.views.strips import LevelStrip, StripGrid
from river_labels import HORIZON_ROW, UNTOUCHED, river_truth

DATA = Path(os.environ.get("RIGWAKE_DATA", Path(__file__).parent.parent.parent / "shared" / "data"))
RIVER = DATA / "marine_river_sequence"


def painted_strip(turn: int = 0) -> LevelStrip:
    """Sky, a dark shore, water, and a white boat in it 4 degrees wide, turned by some columns to the right."""
    rng = np.random.default_rng(3)
    grid = StripGrid()
    elevation = np.rad2deg(grid.elevations())[:, None]
    image = np.zeros((grid.rows, grid.columns, 3))
    image[:] = (235, 225, 215)
    shore = (elevation < 4 + 2 * np.sin(np.arange(grid.columns) / 23.0)[None, :]) & (elevation > -0.6)
    image[shore] = (50, 85, 70)
    image += (
        25
        * shore[..., None]
        * cv2.resize(rng.standard_normal((60, 300)), (grid.columns, grid.rows))[..., None]
    )
    water = elevation < -0.6
    ripples = cv2.resize(rng.standard_normal((95, 120)), (grid.columns, grid.rows))[..., None]
    image = np.where(water[..., None], np.array((75, 65, 45)) + 8 * ripples, image)
    image[72:90, 440:460] = (225, 230, 230)
    image = np.roll(np.clip(image, 0, 255), turn, axis=1).astype(np.uint8)
    camera = np.zeros(image.shape[:2], np.int8)
    camera[-8:] = -1
    return LevelStrip(grid, image, camera, ("front",), LevelAttitude(np.eye(3), 2.0))


def test_the_shipped_network_tells_water_from_sky_and_is_small() -> None:
    labels = segment_strip(painted_strip(), shipped_network())
    assert (labels.classes[:20] == 2).mean() > 0.9
    assert (labels.classes[130:180] == 0).mean() > 0.9
    assert (labels.classes[-8:] == 255).all()
    assert labels.confidence[-8:].max() == 0
    model = Path(__file__).parent.parent / "src" / "rigwake" / "views" / "models" / "water.onnx"
    assert model.stat().st_size < 1_000_000


def test_a_strip_that_wraps_has_no_seam() -> None:
    network, strip = shipped_network(), painted_strip()
    elevation = np.rad2deg(strip.grid.elevations())
    whole = network.probabilities(strip.image, strip.is_seen, elevation, wraps=True)
    turned = network.probabilities(
        np.roll(strip.image, 448, axis=1), np.roll(strip.is_seen, 448, axis=1), elevation, wraps=True
    )
    apart = np.roll(turned, -448, axis=2).argmax(axis=0) != whole.argmax(axis=0)
    assert apart.mean() < 0.01


def test_the_training_sees_what_the_network_sees() -> None:
    import sys

    sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
    import train_segmentation

    strip = painted_strip()
    elevation = np.rad2deg(strip.grid.elevations())
    ours = network_input(strip.image, strip.is_seen, elevation)
    assert np.array_equal(ours, train_segmentation.network_input(strip.image, strip.is_seen, elevation))


def test_the_past_is_turned_with_the_boat() -> None:
    before, after = painted_strip(), painted_strip(17)
    greys = [cv2.cvtColor(s.image, cv2.COLOR_BGR2GRAY).astype(np.float32) for s in (before, after)]
    assert turned_columns(greys[0], greys[1], before.grid) == 17

    class Flickering:
        calls = 0

        def probabilities(self, image, is_seen=None, elevation_deg=None, wraps=False):  # type: ignore[no-untyped-def]
            self.calls += 1
            obstacle = 0.7 if self.calls == 1 else 0.47
            return np.broadcast_to(
                np.array([1 - obstacle - 0.01, obstacle, 0.01], np.float32)[:, None, None],
                (3, *image.shape[:2]),
            ).copy()

    smoothed = SmoothedLabels(Flickering())
    smoothed.next(before)
    second = smoothed.next(after)
    assert (second.classes[second.classes != 255] == 1).mean() > 0.9


def test_a_dark_picture_says_so_and_is_less_sure() -> None:
    strip = painted_strip()
    night = LevelStrip(strip.grid, strip.image // 16, strip.camera, strip.names, strip.attitude)
    labels = segment_strip(night, shipped_network())
    assert "dark" in labels.words
    assert labels.mean_confidence < 0.7


def test_external_networks(tmp_path: Path) -> None:
    image = np.full((50, 70, 3), 90, np.uint8)
    good = tmp_path / "good.onnx"
    good.write_bytes(constant_network([0.0, 3.0, 1.0]))
    found = segment_image(image, external_network(good, ("obstacle", "water", "sky")))
    assert (found.classes == 0).all()
    found = segment_image(image, external_network(good, ("water", "other", "obstacle")))
    assert (found.classes == 1).all()
    with pytest.raises(InputError, match="classes"):
        segment_image(image, external_network(good, ("obstacle", "water")))
    with pytest.raises(UsageError, match="water"):
        external_network(good, ("obstacle", "sea", "sky"))
    bad = tmp_path / "infinite.onnx"
    bad.write_bytes(constant_network([np.inf, 3.0, 1.0]))
    with pytest.raises(EstimationError, match="not numbers"):
        segment_image(image, external_network(bad, ("obstacle", "water", "sky")))
    four = tmp_path / "four.onnx"
    four.write_bytes(one_layer(4, 3))
    with pytest.raises(InputError, match="does not take"):
        segment_image(image, external_network(four, ("obstacle", "water", "sky")))
    text = tmp_path / "text.onnx"
    text.write_bytes(b"this is no network")
    with pytest.raises(InputError, match="cannot be read"):
        external_network(text, ("obstacle", "water", "sky"))


def test_measures_count_what_stands_below_the_horizon() -> None:
    elevation = 10 - np.arange(100) * 0.4
    truth = np.where(elevation[:, None] > 0, 2, 0) * np.ones((1, 200), int)
    truth[20:26] = 1
    truth[30:45, 50:60] = 1
    truth[30:45, 120:130] = 1
    truth = truth.astype(np.uint8)
    comparison = LabelComparison(0.4)
    comparison.add(flat_horizon(truth, elevation), truth, elevation)
    flat = comparison.measures()
    assert flat.recall == 0
    assert (flat.objects, flat.objects_found) == (2, 0)
    assert flat.mean_iou > 0.8  # why this number alone proves nothing
    found = truth.copy()
    found[30:45, 120:130] = 0
    found[60:70, 10:20] = 1
    comparison = LabelComparison(0.4)
    comparison.add(found, truth, elevation, height_m=2.0)
    measures = comparison.measures()
    assert (measures.objects_found, measures.objects, measures.false_objects) == (1, 2, 1)
    assert measures.recall == pytest.approx(0.5)
    assert measures.f1 == pytest.approx(0.5)


def test_the_water_edge_begins_at_the_lowest_seen_pixel() -> None:
    classes = np.array([[2, 2, 2], [1, 0, 1], [0, 0, 1], [0, 0, 1], [255, 0, 0]], np.uint8)
    assert water_edge_rows(classes).tolist() == [1.5, 0.5, 3.5]
    assert np.isnan(water_edge_rows(np.ones((3, 1), np.uint8))).all()


def test_the_colour_method_needs_no_network() -> None:
    labels = segment_strip(painted_strip(), ColourClassifier())
    assert (labels.classes[120:180] == 0).mean() > 0.9
    assert (labels.classes[:10] == 2).mean() > 0.8


def test_segment_on_the_command_line(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), painted_strip().image[:, 300:600])
    run = CliRunner()
    result = run.invoke(build_app(), ["segment", str(folder), "-o", str(tmp_path / "out"), "--json", "-"])
    assert result.exit_code == 0, result.output
    assert cv2.imread(str(tmp_path / "out" / "labels" / "a.png"), cv2.IMREAD_UNCHANGED).shape == (190, 300)
    (folder / "broken.png").write_bytes(b"nothing")
    result = run.invoke(build_app(), ["segment", str(folder), "-o", str(tmp_path / "out")])
    assert isinstance(result.exception, InputError)
    wrong = ["segment", str(folder), "-o", str(tmp_path / "out"), "--measure", str(tmp_path)]
    (folder / "broken.png").unlink()
    assert isinstance(run.invoke(build_app(), wrong).exception, UsageError)


@pytest.mark.skipif(not RIVER.is_dir(), reason="needs marine_river_sequence in RIGWAKE_DATA")
def test_real_boats_on_a_real_river() -> None:
    network, comparison, step = shipped_network(), LabelComparison(0.117), 0.117
    elevation = (HORIZON_ROW - np.arange(384)) * step
    for name in UNTOUCHED:
        image = cv2.imread(str(RIVER / name))
        comparison.add(segment_image(image, network).classes, river_truth(name), elevation)
    measures = comparison.measures()
    assert measures.mean_iou >= 0.85
    assert measures.recall >= 0.85
    assert measures.precision >= 0.8
