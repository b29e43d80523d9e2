"""The main job in seconds: pictures to a rig, with time offsets and cross-camera association, and what it leaves."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ba_rigs import Wanted, true_problem
from basin_recording import OFFSETS_MS, basin, basin_recording
from rigwake._types import Array
from rigwake.ba.rig import association_rounds
from rigwake.ba.rig.association_rounds import adjust_with_association, held_out_landmarks
from rigwake.ba.rig.outlier_rounds import noise_scales
from rigwake.ba.rig.rig_values import AdjustedRig, AdjustmentOptions
from rigwake.ba.rig.search_proposals import AssociationOptions, predicted_pixels, propose_searches
from rigwake.ba.rig.split_checks import association_errors
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import Observations, RigProblem
from rigwake.calibration import load_calibration
from rigwake.config import load_config
from rigwake.evaluation.rig_errors import RigErrors, evaluate_calibration
from rigwake.geometry.interpolate import interpolate
from rigwake.geometry.se3 import SE3
from rigwake.pipeline import calibration_run
from rigwake.pipeline.calibration_run import CalibrationRun, calibrate
from rigwake.pipeline.stream_selection import Selection
from rigwake.readers.trajectories import read_trajectory
from rigwake.readers.truth_files import rig_in_frame
from rigwake.recording import Recording
from rigwake.report.adjustment_file import read_adjustment
from rigwake.rig import Rig
from rigwake.tracks import load_tracks
from rigwake.writers.write import write_recording

pytestmark = pytest.mark.xdist_group("basin")
CHI_SQUARE_6 = 22.5  # 99.9 %


@dataclass(frozen=True, eq=False)
class Sail:
    recording: Recording
    path: Path
    run: CalibrationRun
    estimated_from: tuple[Any, ...]
    truth: Rig
    errors: RigErrors


@pytest.fixture(scope="module")
def sail(tmp_path_factory: pytest.TempPathFactory) -> Sail:
    folder = tmp_path_factory.mktemp("basin")
    simulated = basin()
    recording = basin_recording(simulated, folder / "memory")
    write_recording(recording, folder / "rec")
    with pytest.MonkeyPatch.context() as patch:
        inputs = _noted(patch)
        run = calibrate(folder / "rec", folder / "out", load_config(jobs=1))
    truth = rig_in_frame(simulated.rig, run.calibration.reference)
    return Sail(
        recording, folder / "rec", run, inputs[0], truth, evaluate_calibration(run.calibration, truth)
    )


def _noted(patch: pytest.MonkeyPatch, *, stop: type[Exception] | None = None) -> list[tuple[Any, ...]]:
    """What the rig is estimated from, filled as runs get there; with `stop`, they end there by that."""
    found, estimate = [], calibration_run.estimate_vetted_rig

    def note(opened: Recording, selection: Selection, *given: Any, **chosen: Any) -> Any:
        found.append((*given, selection, chosen))
        if stop is not None:
            raise stop
        return estimate(opened, selection, *given, **chosen)

    patch.setattr(calibration_run, "estimate_vetted_rig", note)
    return found


def _apart(true: SE3, found: SE3) -> tuple[Array, Array]:
    """Degrees and metres between two motions, but for the origin of the world, which is the first fix of the GNSS."""
    shift = found.translation - true.translation
    turned = np.linalg.norm(true.local(found)[:, :3], axis=1)
    return np.rad2deg(turned), np.linalg.norm(shift - np.median(shift, axis=0), axis=1)


class TestTheRig:
    def test_is_near_the_truth(self, sail: Sail) -> None:
        assert sail.run.calibration.reference == "imu"
        for errors in sail.errors.cameras.values():
            assert errors.rotation_error_deg < 0.05
            assert np.abs(errors.translation_error_m).max() < 0.03

    def test_is_within_its_own_uncertainty_and_that_is_small(self, sail: Sail) -> None:
        for name, errors in sail.errors.cameras.items():
            assert errors.nees is not None
            assert errors.nees < CHI_SQUARE_6
            camera = sail.run.calibration.cameras[name]
            assert 0.002 < camera.std_translation_m.max() < 0.03
            assert 0.002 < camera.std_rotation_deg.max() < 0.05

    def test_has_the_time_offsets_with_their_sign(self, sail: Sail) -> None:
        for name, camera in sail.run.calibration.cameras.items():
            assert camera.time_offset_s == pytest.approx(1e-3 * OFFSETS_MS[name], abs=7e-4)
            assert 0 < (camera.time_offset_std_s or 0.0) < 1e-3

    def test_was_checked_by_held_out_landmarks_and_split_halves(self, sail: Sail) -> None:
        checks = sail.run.calibration.checks
        assert checks["hand_over"]["count"] >= 20
        assert checks["hand_over"]["median_px"] < 0.5
        assert any(
            "->" in pair and pair.split("->")[0] != pair.split("->")[1]
            for pair in checks["hand_over"]["by_pair"]
        )
        assert set(checks["split_half"]) == set(OFFSETS_MS)
        for half in checks["split_half"].values():
            assert half["sigmas"] < 4
            assert [np.isfinite(h["std_translation_m"]).all() for h in half["halves"]] == [True, True]
            assert half["rotation_deg"] < 0.2
        assert checks["converged"] is True
        assert checks["failed_cameras"] == {}
        for residuals in checks["residuals"].values():
            assert residuals["rms_px"] < 0.5
            assert residuals["observations"] > 500


class TestWhatIsLeft:
    def test_the_file_says_what_the_value_says(self, sail: Sail) -> None:
        read, made = load_calibration(sail.run.out / "calibration.yaml"), sail.run.calibration
        for name, camera in made.cameras.items():
            again = read.cameras[name]
            np.testing.assert_allclose(again.rig_from_cam.matrix, camera.rig_from_cam.matrix, atol=1e-9)
            np.testing.assert_allclose(again.covariance, camera.covariance, rtol=1e-6, atol=1e-15)
            assert again.time_offset_s == pytest.approx(camera.time_offset_s, abs=1e-9)

    def test_trajectories_are_the_true_ones(self, sail: Sail) -> None:
        """On the camera's clock: what is stamped t was at the place of t + time offset."""
        rig = sail.recording.true_trajectories["rig"]
        imu_from_cams = {name: camera.rig_from_cam for name, camera in sail.truth.cameras.items()}
        rig_from_imu = sail.recording.true_rig.rig_from_imu  # type: ignore[union-attr]
        for name, imu_from_cam in imu_from_cams.items():
            found = read_trajectory(sail.run.out / "trajectories" / f"{name}.tum").trajectory
            at = found.timestamps_ns + round(1e6 * OFFSETS_MS[name])
            inside = (at >= rig.timestamps_ns[0]) & (at <= rig.timestamps_ns[-1])
            true = (
                interpolate(rig.timestamps_ns, rig.world_from_body, at[inside]) * rig_from_imu * imu_from_cam
            )
            turned_deg, moved_m = _apart(true, found.world_from_body[inside])
            assert inside.sum() > 40
            assert np.median(turned_deg) < 0.1
            assert np.median(moved_m) < 0.03

    def test_the_rigs_own_trajectory_is_that_of_the_imu(self, sail: Sail) -> None:
        rig = sail.recording.true_trajectories["rig"]
        found = read_trajectory(sail.run.out / "trajectories" / "rig.tum").trajectory
        true = interpolate(rig.timestamps_ns, rig.world_from_body, found.timestamps_ns)
        turned_deg, moved_m = _apart(true * sail.recording.true_rig.rig_from_imu, found.world_from_body)  # type: ignore[union-attr]
        assert np.median(turned_deg) < 0.1
        assert np.median(moved_m) < 0.03

    def test_residuals_are_predicted_minus_observed(self, sail: Sail) -> None:
        with np.load(sail.run.out / "residuals.npz", allow_pickle=False) as table:
            names = table["camera_names"].tolist()
            lengths = np.linalg.norm(table["residuals_px"], axis=1)
            assert np.isfinite(lengths).all()
            for index, name in enumerate(names):
                own = table["camera"] == index
                stated = sail.run.calibration.checks["residuals"][name]
                assert own.sum() == stated["observations"]
                assert np.sqrt(np.mean(lengths[own] ** 2)) == pytest.approx(stated["rms_px"], rel=1e-3)
                assert np.isin(table["timestamp_ns"][own], sail.recording.cameras[name].timestamps_ns).all()
                model = sail.recording.cameras[name].model
                assert model is not None
                bearings, _ = model.unproject(table["pixels"][own].astype(float))
                np.testing.assert_allclose(
                    np.cos(np.deg2rad(table["angle_deg"][own])), bearings[:, 2], atol=1e-3
                )

    def test_the_initial_guess_is_near_and_on_the_reference_camera(self, sail: Sail) -> None:
        first = load_calibration(sail.run.out / "initial_rig.yaml")
        (other,) = first.cameras
        true = (
            sail.truth.cameras[first.reference].rig_from_cam.inverse()
            * sail.truth.cameras[other].rig_from_cam
        )
        error = true.local(first.cameras[other].rig_from_cam)
        assert np.rad2deg(np.linalg.norm(error[:3])) < 1.0
        assert sail.run.calibration.provenance["leader"] == first.reference

    def test_pictures_lie_on_what_they_show(self, sail: Sail) -> None:
        entries = json.loads((sail.run.out / "pictures" / "pictures.json").read_text())
        assert {entry["kind"] for entry in entries} == {"horizon", "hand_over", "patches"}
        distances = []
        for entry in entries:
            assert (sail.run.out / "pictures" / entry["file"]).is_file()
            for point in entry["points"]:
                distances.append(np.hypot(*np.subtract(point["predicted_px"], point["observed_px"])))
        assert np.median(distances) < 0.5

    def test_patches_look_as_predicted(self, sail: Sail) -> None:
        folder, alike = sail.run.out / "pictures", []
        entries = json.loads((folder / "pictures.json").read_text())
        patches = [entry for entry in entries if entry["kind"] == "patches"]
        assert 2 <= len(patches) <= 24
        assert any(entry["camera"] != entry["points"][0]["from_camera"] for entry in patches)
        for entry in patches:
            tiles = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_GRAYSCALE)
            side = len(tiles)
            assert tiles.shape == (side, 3 * side)
            predicted, found = tiles[:, side : 2 * side], tiles[:, 2 * side :]
            alike.append(np.corrcoef(predicted.ravel(), found.ravel())[0, 1])
        assert np.median(alike) > 0.8

    def test_sensors_and_landmarks_are_kept_for_the_report(self, sail: Sail) -> None:
        record = read_adjustment(sail.run.out / "adjustment.npz")
        assert record.landmarks is not None
        assert record.imu_turn is not None
        page = (sail.run.out / "report.html").read_text()
        assert "IMU over time" in page
        assert "adjustment.npz" not in page  # nothing is missing

    def test_tracks_hold_bearings_of_their_pixels(self, sail: Sail) -> None:
        for name in OFFSETS_MS:
            tracks = load_tracks(sail.run.out / "tracks" / f"{name}.npz")
            model = sail.recording.cameras[name].model
            assert model is not None
            bearings, _ = model.unproject(tracks.pixels)
            np.testing.assert_allclose(tracks.bearings_cam, bearings, atol=1e-9)


class TestResume:
    def test_finished_cameras_are_not_tracked_again(
        self, sail: Sail, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The rig is estimated from the very same once more."""

        class EnoughError(Exception):
            pass

        def refuse(*_: object, **__: object) -> None:
            raise AssertionError("tracked again")

        inputs = _noted(monkeypatch, stop=EnoughError)
        with pytest.raises(EnoughError):
            calibrate(
                sail.path,
                sail.run.out,
                load_config(jobs=1),
                resume=True,
                run_cameras=refuse,
            )
        (
            (tracks, trajectories, *_, selection, chosen),
            (first_tracks, first_trajectories, *_, first, first_chosen),
        ) = (
            inputs[0],
            sail.estimated_from,
        )
        told = ("external", "without_horizon", "guessed")
        assert [chosen[name] for name in told] == [first_chosen[name] for name in told]
        np.testing.assert_array_equal(selection.imu.gyro, first.imu.gyro)
        np.testing.assert_array_equal(selection.imu.timestamps_ns, first.imu.timestamps_ns)
        for name in OFFSETS_MS:
            lens, first_lens = selection.cameras[name].model, first.cameras[name].model
            np.testing.assert_array_equal(lens.params, first_lens.params)
            np.testing.assert_array_equal(
                selection.cameras[name].timestamps_ns, first.cameras[name].timestamps_ns
            )
        assert set(tracks) == set(first_tracks) == set(OFFSETS_MS)
        for name in OFFSETS_MS:
            np.testing.assert_array_equal(tracks[name].frame_indices, first_tracks[name].frame_indices)
            np.testing.assert_array_equal(tracks[name].track_ids, first_tracks[name].track_ids)
            np.testing.assert_array_equal(tracks[name].pixels, first_tracks[name].pixels)
            again, before = trajectories[name], first_trajectories[name]
            np.testing.assert_array_equal(again.timestamps_ns, before.timestamps_ns)
            np.testing.assert_array_equal(again.world_from_body.matrix, before.world_from_body.matrix)
            np.testing.assert_array_equal(again.covariances, before.covariances)

    @pytest.mark.parametrize(
        "setting", ["tracking.max_features=300", "duration_s=15.5", "find_self_mask=false"]
    )
    def test_what_the_stage_depends_on_starts_it_again(self, sail: Sail, setting: str) -> None:
        class TrackedError(Exception):
            pass

        def note(*_: object, **__: object) -> None:
            raise TrackedError

        config = load_config(None, (setting,), jobs=1)
        with pytest.raises(TrackedError):
            calibrate(sail.path, sail.run.out, config, resume=True, run_cameras=note)


OFFSETS_S = (0.03, -0.02)


@pytest.fixture(scope="module")
def exact() -> RigProblem:
    """Two cameras with time offsets, at the true values, noise-free pixels."""
    return true_problem(
        Wanted(cameras=2, seconds=12, landmarks=160, noise_px=0.0, offsets_s=OFFSETS_S, far=40, gnss_std=None)
    )


class TestPredictions:
    def test_landmarks_are_predicted_where_they_were_seen_whatever_the_time_offsets(
        self, exact: RigProblem
    ) -> None:
        """The boat turns by 0.5 deg in 30 ms: 2 px, which a wrong sign would double."""
        seen = exact.observations
        after, before = exact.states.timestamps_ns[1], exact.states.timestamps_ns[-2]
        inner = np.flatnonzero((seen.timestamps_ns > after) & (seen.timestamps_ns < before))
        error = predicted_pixels(exact, seen.take(inner)) - seen.pixels[inner]
        assert np.nanmedian(np.linalg.norm(error, axis=1)) < 0.2  # between states by interpolation

    def test_searches_are_proposed_where_the_other_camera_sees_the_landmark(self, exact: RigProblem) -> None:
        usable = {c.name: np.ones((480, 640), bool) for c in exact.cameras}
        stamps = {c.name: np.unique(exact.observations.timestamps_ns) for c in exact.cameras}
        own, _ = _by_first_camera(exact)
        searches = propose_searches(replace(exact, observations=own), stamps, usable, AssociationOptions())
        searches = searches.take(searches.cameras == 1)
        assert len(searches) > 20
        seen = exact.observations
        table = {
            (c, t, k): row
            for row, (c, t, k) in enumerate(
                zip(
                    seen.camera_indices.tolist(),
                    seen.timestamps_ns.tolist(),
                    seen.landmark_indices.tolist(),
                    strict=True,
                )
            )
        }
        keys = zip(
            searches.cameras.tolist(), searches.stamps.tolist(), searches.landmarks.tolist(), strict=True
        )
        rows = np.array([table.get(key, -1) for key in keys])
        known = rows >= 0
        off = np.linalg.norm(searches.pixels[known] - seen.pixels[rows[known]], axis=1)
        assert known.sum() > 10
        assert np.median(off) < 0.3


class TestHeldOut:
    def test_held_out_landmarks_never_enter_the_fit(
        self, exact: RigProblem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """Each round finds every other camera's observations; those of held-out landmarks only come back unused."""
        own, found = _by_first_camera(exact)
        problem = replace(exact, observations=own)
        solution = solve(problem)
        tracks = np.arange(len(problem.landmarks), dtype=np.int64)
        adjusted = AdjustedRig(solution, np.zeros(len(tracks), np.int64), tracks, {}, {})
        fitted: list[Observations] = []

        def pass_on(assembled, *_: object, **__: object) -> AdjustedRig:  # type: ignore[no-untyped-def]
            fitted.append(assembled.problem.observations)
            # the rounds renumber landmarks as outliers go: here the first five
            kept = np.arange(5 if len(fitted) == 1 else 0, len(assembled.problem.landmarks))
            return _reduced(replace(adjusted.solution, problem=assembled.problem), assembled, kept)

        monkeypatch.setattr(association_rounds, "adjust", pass_on)
        monkeypatch.setattr(association_rounds, "propose_searches", lambda *_: None)

        def all_found(*_: object) -> Observations:
            first = 5 if fitted else 0  # how many went
            rows = found.landmark_indices >= first
            return replace(found, landmark_indices=found.landmark_indices - first).take(rows)

        monkeypatch.setattr(association_rounds, "find_landmarks", all_found)
        held = held_out_landmarks(adjusted)
        assert 0.05 < held.mean() < 0.3
        result, matches = adjust_with_association(
            adjusted, {}, tmp_path, AdjustmentOptions(), AssociationOptions(), lambda _: None
        )
        assert len(fitted) == 2
        for number, observations in enumerate(fitted):
            names = observations.landmark_indices + (5 if number else 0)
            added = observations.camera_indices == 1
            assert added.any()
            assert not held[names[added]].any()
        assert len(matches.unused) > 0
        assert held[result.track_ids[matches.unused.landmark_indices]].all()
        assert association_errors(result.solution, matches.unused)["median_px"] < 0.3


def _by_first_camera(problem: RigProblem) -> tuple[Observations, Observations]:
    """Observations of each landmark by camera 0, if it saw it, as its track; those of camera 1 as found later."""
    seen = problem.observations
    return seen.take(seen.camera_indices == 0), seen.take(seen.camera_indices == 1)


def _reduced(solution, assembled, kept) -> AdjustedRig:  # type: ignore[no-untyped-def]
    problem = solution.problem
    rows = np.isin(problem.observations.landmark_indices, kept)
    part = problem.observations.take(rows)
    part = replace(part, landmark_indices=np.searchsorted(kept, part.landmark_indices).astype(np.int64))
    reduced = replace(problem, landmarks=problem.landmarks.take(kept), observations=part)
    return AdjustedRig(
        replace(solution, problem=reduced), assembled.track_cameras[kept], assembled.track_ids[kept], {}, {}
    )


class TestNoiseScale:
    @pytest.mark.parametrize(("least", "low"), [(2, 0.93), (20, 0.97)])
    def test_counts_what_the_landmarks_took(self, least: int, low: float) -> None:
        """Residuals of landmarks seen three times are a third smaller than the noise; the scale is not."""
        problem = true_problem(Wanted(cameras=2, seconds=8, landmarks=700, noise_px=0.4, far=60))
        seen = problem.observations
        rank = np.zeros(len(seen), np.int64)
        order = np.lexsort((seen.timestamps_ns, seen.camera_indices, seen.landmark_indices))
        starts = np.flatnonzero(np.diff(seen.landmark_indices[order], prepend=-1))
        counts = np.diff(np.append(starts, len(order)))
        rank[order] = np.arange(len(order)) - np.repeat(starts, counts)
        few = seen.take(rank < least + 1)
        counts = np.bincount(few.landmark_indices, minlength=len(problem.landmarks))
        kept = np.flatnonzero(counts >= 3)
        few = few.take(np.isin(few.landmark_indices, kept))
        few = replace(few, landmark_indices=np.searchsorted(kept, few.landmark_indices).astype(np.int64))
        solution = solve(replace(problem, landmarks=problem.landmarks.take(kept), observations=few))
        assert low < noise_scales(solution).mean() < 1.03
