"""From initial values to verdicts, on tracks whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest

from ba_rigs import Wanted, free_cameras, true_problem
from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem, triangulate_landmarks
from rigwake.ba.rig.gauge import with_gauge
from rigwake.ba.rig.outlier_rounds import adjust, drop_outliers
from rigwake.ba.rig.rig_values import AdjustedRig, AdjustmentOptions
from rigwake.ba.rig.rig_verdicts import ReferenceFrame, calibrated_cameras
from rigwake.ba.rig.split_checks import part_of, split_half, split_half_summary
from rigwake.ba.solver.covariance import covariance_of
from rigwake.ba.solver.levenberg_marquardt import solve
from rigwake.ba.solver.rig_problem import RigSolution, SolverOptions
from rigwake.errors import EstimationError, UnobservableError, UsageError
from rigwake.geometry.se3 import SE3
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.tracks_only import SimulatedTracks

OPTIONS = AdjustmentOptions(state_rate_hz=3.0, tracks_per_second=8)
IMU = ReferenceFrame("imu", SE3.identity())


@pytest.fixture(scope="module")
def world() -> SimulatedTracks:
    return sail(features=50)


@pytest.fixture(scope="module")
def adjusted(world: SimulatedTracks) -> AdjustedRig:
    return adjust(assemble_problem(measurements(world), first_values(world), OPTIONS), OPTIONS)


class TestAssemble:
    def test_states_are_frames_near_a_regular_grid(self, world: SimulatedTracks) -> None:
        problem = assemble_problem(measurements(world), first_values(world), OPTIONS).problem
        stamps = problem.states.timestamps_ns
        assert np.isin(stamps, world.tracks["front"].timestamps_ns).all()
        assert np.diff(stamps).min() > 0
        assert len(stamps) == pytest.approx(OPTIONS.state_rate_hz * (stamps[-1] - stamps[0]) * 1e-9, rel=0.05)

    def test_no_second_of_a_camera_has_more_tracks_than_asked_for(self, world: SimulatedTracks) -> None:
        assembled = assemble_problem(measurements(world), first_values(world), OPTIONS)
        seen = assembled.problem.observations
        first = np.full(len(assembled.track_ids), np.iinfo(np.int64).max)
        np.minimum.at(first, seen.landmark_indices, seen.timestamps_ns)
        for camera in range(2):
            _, counts = np.unique(first[assembled.track_cameras == camera] // 10**9, return_counts=True)
            assert 1 <= counts.max() <= OPTIONS.tracks_per_second
        assert np.bincount(seen.landmark_indices).min() >= OPTIONS.min_observations

    def test_chosen_tracks_come_from_all_over_the_image(self, world: SimulatedTracks) -> None:
        seen = assemble_problem(measurements(world), first_values(world), OPTIONS).problem.observations
        model = world.recording.cameras["front"].model
        assert model is not None
        of_front = seen.pixels[seen.camera_indices == 0]
        given = world.tracks["front"].pixels
        for axis in range(2):
            assert np.ptp(of_front[:, axis]) > 0.9 * np.ptp(given[:, axis])

    def test_landmarks_are_where_they_are(self, world: SimulatedTracks) -> None:
        start = first_values(world, turn_deg=0.0, shift_m=0.0)
        truth = world.recording.true_trajectories["rig"]
        exact = replace(
            start,
            world_from_rig=replace(
                start.world_from_rig,
                world_from_body=truth.world_from_body * world.recording.true_rig.rig_from_imu,
            ),
        )
        assembled = assemble_problem(measurements(world), exact, OPTIONS)
        problem = assembled.problem
        found = triangulate_landmarks(
            exact, problem.cameras, problem.observations, len(assembled.track_ids)
        ).points_world
        error = np.empty(len(found))
        for camera, name in enumerate(("front", "left")):
            tracks, known = world.tracks[name], world.truth[name]
            rows = np.flatnonzero(assembled.track_cameras == camera)
            first_row = np.array([np.argmax(tracks.track_ids == t) for t in assembled.track_ids[rows]])
            true_points = world.landmarks_world[known.landmark_ids[first_row]]
            ranges = np.linalg.norm(true_points - problem.landmarks.anchors_world[rows], axis=1)
            error[rows] = np.linalg.norm(found[rows] - true_points, axis=1) / ranges
        assert np.median(error) < 0.05

    def test_clocks_without_common_time_are_refused(self, world: SimulatedTracks) -> None:
        tracks = {
            name: replace(t, timestamps_ns=t.timestamps_ns + 10**12) for name, t in world.tracks.items()
        }
        with pytest.raises(EstimationError, match="span"):
            assemble_problem(replace(measurements(world), tracks=tracks), first_values(world), OPTIONS)

    def test_tracks_that_do_not_last_are_refused(self, world: SimulatedTracks) -> None:
        options = replace(OPTIONS, min_observations=10_000)
        with pytest.raises(EstimationError, match="last"):
            assemble_problem(measurements(world), first_values(world), options)


class TestOutliers:
    def test_what_is_off_is_dropped_and_little_else(self) -> None:
        problem = true_problem(Wanted(cameras=2, seconds=6, landmarks=120, noise_px=0.3))
        rng = np.random.default_rng(0)
        wrong = rng.random(len(problem.observations)) < 0.03
        pixels = problem.observations.pixels + np.where(wrong, 1.0, 0.0)[:, None] * 20.0
        noise = (
            problem.observations.pixels
            - true_problem(Wanted(cameras=2, seconds=6, landmarks=120, noise_px=0.0)).observations.pixels
        )
        residuals = noise + (pixels - problem.observations.pixels)
        broken = replace(problem, observations=replace(problem.observations, pixels=pixels))
        solution = RigSolution(broken, residuals, solve(problem, SolverOptions(max_iterations=1)).report)
        reduced, kept, scales, lost = drop_outliers(solution, 4.0, 3)
        assert lost.sum() == pytest.approx(wrong.sum(), rel=0.2)
        assert scales == pytest.approx(1.0, abs=0.1)
        assert len(reduced.observations) == len(wrong) - lost.sum()
        assert np.bincount(reduced.observations.landmark_indices).min() >= 3
        np.testing.assert_array_equal(reduced.landmarks.points_world, problem.landmarks.points_world[kept])

    def test_too_few_landmarks_are_refused(self) -> None:
        problem = true_problem(Wanted(cameras=1, seconds=3, landmarks=15))
        solution = solve(problem, SolverOptions(max_iterations=1))
        with pytest.raises(EstimationError, match="landmarks agree"):
            drop_outliers(solution, 4.0, 3)


class TestVerdicts:
    def test_the_rig_is_found_within_its_own_uncertainty(
        self, world: SimulatedTracks, adjusted: AdjustedRig
    ) -> None:
        covariance = covariance_of(adjusted.solution.problem)
        found = calibrated_cameras(adjusted.solution, covariance, IMU, {}, {})
        truth = rig_in_frame(world.recording.true_rig, "imu")
        assert found.joint_covariance is not None
        error = np.concatenate(
            [
                truth.cameras[name].rig_from_cam.local(camera.rig_from_cam)
                for name, camera in found.cameras.items()
            ]
        )
        assert error @ np.linalg.solve(found.joint_covariance, error) < 33  # chi-square 12, 99.9 %
        for camera in found.cameras.values():
            assert camera.is_observable
            assert abs(camera.time_offset_s or 0.0) < 5 * (camera.time_offset_std_s or 0.0)

    def test_a_camera_as_reference_takes_its_own_uncertainty_along(self, adjusted: AdjustedRig) -> None:
        """Against a Monte Carlo over the joint covariance in the IMU's frame."""
        covariance = covariance_of(adjusted.solution.problem)
        by_imu = calibrated_cameras(adjusted.solution, covariance, IMU, {}, {})
        by_left = calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("left", None), {}, {})
        assert by_imu.joint_covariance is not None
        front, left = (by_imu.cameras[n].rig_from_cam for n in ("front", "left"))
        steps = np.random.default_rng(0).multivariate_normal(np.zeros(12), by_imu.joint_covariance, 20_000)
        moved = left.retract(steps[:, 6:]).inverse() * front.retract(steps[:, :6])
        expected = np.cov((left.inverse() * front).local(moved).T)
        found = by_left.cameras["front"].covariance
        root = np.linalg.inv(np.linalg.cholesky(expected))
        np.testing.assert_allclose(root @ found @ root.T, np.eye(6), atol=0.1)
        assert not by_left.cameras["left"].covariance.any()

    def test_base_link_moves_cameras_and_antenna_and_keeps_the_uncertainty(
        self, adjusted: AdjustedRig
    ) -> None:
        covariance = covariance_of(adjusted.solution.problem)
        base_from_imu = SE3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0]))
        by_imu = calibrated_cameras(adjusted.solution, covariance, IMU, {}, {})
        by_base = calibrated_cameras(
            adjusted.solution, covariance, ReferenceFrame("base_link", base_from_imu), {}, {}
        )
        for name, camera in by_imu.cameras.items():
            expected = base_from_imu * camera.rig_from_cam
            np.testing.assert_allclose(by_base.cameras[name].rig_from_cam.matrix, expected.matrix, atol=1e-12)
            np.testing.assert_allclose(by_base.cameras[name].covariance, camera.covariance, rtol=1e-9)
        assert by_imu.antenna_rig is not None
        np.testing.assert_allclose(by_base.antenna_rig, base_from_imu * by_imu.antenna_rig, atol=1e-12)

    def test_without_a_scale_no_offset_is_told(self, adjusted: AdjustedRig) -> None:
        covariance = covariance_of(adjusted.solution.problem)
        unscaled = ReferenceFrame("left", None, is_metric=False)
        front = calibrated_cameras(adjusted.solution, covariance, unscaled, {}, {}).cameras["front"]
        assert front.observable_axes.tolist() == [True] * 3 + [False] * 3
        assert np.isnan(front.rig_from_cam.translation).all()
        assert all("baseline" in direction.remedy for direction in front.unobservable)

    def test_unknown_references_and_lonely_cameras(self, adjusted: AdjustedRig) -> None:
        covariance = covariance_of(adjusted.solution.problem)
        with pytest.raises(UsageError, match="front, left"):
            calibrated_cameras(adjusted.solution, covariance, ReferenceFrame("mast", None), {}, {})
        lonely = free_cameras(true_problem(Wanted(cameras=1, seconds=4, landmarks=60)), "rig_from_cam")
        solution = solve(lonely)
        with pytest.raises(UnobservableError, match="only cam0 is left"):
            calibrated_cameras(
                solution, covariance_of(solution.problem), ReferenceFrame("cam0", None), {}, {}
            )


class TestHalves:
    def test_halves_agree_within_their_sigmas(self, adjusted: AdjustedRig) -> None:
        halves = split_half(adjusted.solution.problem, IMU, OPTIONS)
        summary = split_half_summary(halves)
        assert set(summary) == {"front", "left"}
        for camera in summary.values():
            assert 0 < camera["sigmas"] < 2.5
            assert camera["rotation_deg"] < 0.5

    def test_a_part_holds_only_its_own_time(self, adjusted: AdjustedRig) -> None:
        problem = adjusted.solution.problem
        part = part_of(problem, 10, 50, 4)
        assert len(part.states) == 40
        stamps = part.states.timestamps_ns
        margin = 2e8
        assert (part.observations.timestamps_ns >= stamps[0] - margin).all()
        assert (part.observations.timestamps_ns <= stamps[-1] + margin).all()
        assert np.bincount(part.observations.landmark_indices, minlength=len(part.landmarks)).min() >= 4

    @pytest.mark.parametrize("imu", [True, False])
    def test_a_part_without_gnss_holds_its_own_gauge(self, imu: bool) -> None:
        wanted = Wanted(cameras=2, seconds=12, landmarks=150, gnss_std=None, imu=imu)
        problem = with_gauge(free_cameras(true_problem(wanted), "rig_from_cam"))
        if not imu:
            held = replace(problem.cameras[0], free=frozenset())
            problem = replace(problem, cameras=(held, problem.cameras[1]))
        reference = IMU if imu else ReferenceFrame("cam0", None)
        summary = split_half_summary(split_half(problem, reference, OPTIONS))
        assert np.isfinite(summary["cam1"]["translation_m"]).all()

    def test_a_half_that_determines_nothing_says_so(self) -> None:
        wanted = Wanted(cameras=2, seconds=4, landmarks=60, gnss_std=None, imu=False)
        problem = free_cameras(true_problem(wanted), "rig_from_cam")
        few = replace(OPTIONS, min_observations=100)
        for camera in split_half_summary(split_half(problem, IMU, few)).values():
            assert camera["sigmas"] is None
            assert not np.isfinite(camera["translation_m"]).any()


class TestClusters:
    def rig(self, seed: int, lasting_px: float) -> RigSolution:
        """Every track swings about its place with a period of 8 s and a phase of its own."""
        wanted = Wanted(cameras=2, seconds=10, landmarks=400, seed=seed, gnss_std=None, imu=False)
        problem = with_gauge(free_cameras(true_problem(wanted), "rig_from_cam"))
        held = replace(problem.cameras[0], free=frozenset())
        problem = replace(problem, cameras=(held, problem.cameras[1]))
        seen = problem.observations
        rng = np.random.default_rng(seed)
        tracks = 2 * seen.landmark_indices + seen.camera_indices
        phase = rng.uniform(0, 2 * np.pi, (2 * len(problem.landmarks), 2))[tracks]
        age_s = (seen.timestamps_ns - seen.timestamps_ns.min()) * 1e-9
        pixels = seen.pixels + lasting_px * np.sin(2 * np.pi * age_s[:, None] / 8 + phase)
        return solve(replace(problem, observations=replace(seen, pixels=pixels)))

    def stds(self, solution: RigSolution, clustered: bool) -> np.ndarray:
        covariance, _ = covariance_of(solution.problem, clustered=clustered).parameter("cam1", "rig_from_cam")
        return np.sqrt(np.diag(covariance))

    def test_independent_errors_have_the_predicted_spread(self) -> None:
        solution = self.rig(0, 0.0)
        ratio = self.stds(solution, True) / self.stds(solution, False)
        assert (ratio >= 1 - 1e-9).all()
        assert np.median(ratio) < 1.15

    def test_errors_that_last_along_a_track_widen(self) -> None:
        solution = self.rig(0, 0.6)
        ratio = self.stds(solution, True) / self.stds(solution, False)
        assert np.median(ratio) > 1.5


def test_a_direction_open_in_the_antenna_alone_leaves_the_cameras_determined() -> None:
    """Turns about one axis leave the antenna's height open; points that both cameras see tie the cameras."""
    wanted = Wanted(cameras=2, seconds=8.0, landmarks=80, imu=False, waves=0.0)
    problem = free_cameras(true_problem(wanted), "rig_from_cam")
    held = replace(problem.cameras[0], free=frozenset())
    problem = replace(
        problem, cameras=(held, problem.cameras[1]), antenna=replace(problem.antenna, free=True)
    )
    # at the true values: noise in the estimated states would add spurious a little information
    solution = replace(solve(problem, SolverOptions(max_iterations=1)), problem=problem)
    covariance = covariance_of(problem)
    assert abs(covariance.fractions[0]) < 1e-7  # zero, but for rounding
    covariance = replace(covariance, fractions=np.concatenate([[0.0], covariance.fractions[1:]]))
    _, known = covariance.parameter("antenna", "position_rig")
    assert not known.all()
    assert covariance.parameter("cam1", "rig_from_cam")[1].all()
    found = calibrated_cameras(solution, covariance, ReferenceFrame("cam0", None), {}, {}).cameras["cam1"]
    assert found.observable_axes.all()
    assert found.std_translation_m.max() < 0.1
