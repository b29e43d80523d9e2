"""Sections that do not touch: each with its own states, one rig, errors within their sigmas."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration_worlds import own_odometry
from rigwake.config import load_config
from rigwake.evaluation.rig_errors import evaluate_calibration
from rigwake.excerpt import camera_between, gnss_between
from rigwake.pipeline.prior import RigPrior
from rigwake.pipeline.rig_stage import estimate_rig, initialise_rig
from rigwake.pipeline.sensor_checks import vet_sensors
from rigwake.pipeline.stream_selection import select
from rigwake.readers.truth_files import rig_in_frame
from rigwake.simulation.scenario import build_scenario, load_scenario
from rigwake.simulation.setup import build_recording, prepare
from rigwake.simulation.track_stream import tracks_within
from rigwake.simulation.tracks_only import NoFrames, SimulatedTracks

SPANS_S = [(10.0, 26.0), (72.0, 96.0), (110.0, 122.0)]
LEGS = [
    {"type": "straight", "duration_s": 70, "speed_mps": 0.8},
    {"type": "turn", "rate_deg_s": 18, "angle_deg": 360, "speed_mps": 2.0},
    {"type": "turn", "rate_deg_s": -18, "angle_deg": 360},
    {"type": "straight", "duration_s": 12},
]


def test_tracks_within_spans_never_reach_from_one_to_the_next() -> None:
    tracks = world().tracks["front"]
    seconds = (tracks.timestamps_ns - tracks.timestamps_ns[0]) * 1e-9 + SPANS_S[0][0]
    number = np.searchsorted([a for a, _ in SPANS_S], seconds + 0.01) - 1
    assert sorted(set(number.tolist())) == [0, 1, 2]
    spans_of_tracks = {
        (int(i), int(n)) for i, n in zip(tracks.track_ids, number[tracks.frame_indices], strict=True)
    }
    assert len(spans_of_tracks) == len({i for i, _ in spans_of_tracks})


def world() -> SimulatedTracks:
    """Two cameras in waves of 10 cm, with the tracks and fixes of three spans."""
    document = load_scenario("demo").model_dump()
    document["cameras"] = [c for c in document["cameras"] if c["name"] in ("front", "left")]
    document["tracking"] |= {"features": 80, "landmarks": 1200, "outliers": 0.005, "water": 0.0}
    document |= {"duration_s": 122, "scene": {"layout": "harbour", "size_m": [120, 76]}}
    document["sea"] |= {"hs_m": 0.1}
    document["vessel"]["manoeuvres"] = LEGS
    simulated = prepare(build_scenario(document, "apart"))
    recording = build_recording(
        simulated, {c.name: NoFrames() for c in simulated.scenario.cameras}, Path("apart")
    )
    spans = [
        (simulated.start_ns + round(a * 1e9), simulated.start_ns + round(b * 1e9) - 1) for a, b in SPANS_S
    ]
    part = replace(
        recording,
        cameras={name: camera_between(camera, spans) for name, camera in recording.cameras.items()},
        gnss={name: gnss_between(gnss, *spans) for name, gnss in recording.gnss.items()},
    )
    return SimulatedTracks(tracks_within(simulated, SPANS_S), {}, np.zeros((0, 3)), part)


@pytest.mark.slow
def test_rig_of_three_sections_is_within_its_sigmas() -> None:
    simulated = world()
    config = load_config(None, ("adjustment.cross_camera=false", "intrinsics=fixed"))
    selection = select(simulated.recording, config)
    own = own_odometry(simulated)
    assert set(own) == {"front", "left"}
    vetted = vet_sensors(selection, simulated.tracks, own, repair=True)
    assert not [check for check in vetted.checks if "gnss" in check.sensor and not check.agrees]
    first = initialise_rig(selection, own, config, RigPrior())
    found = estimate_rig(
        simulated.recording,
        vetted.selection,
        simulated.tracks,
        first,
        config,
        RigPrior(),
        masks=Path("nowhere"),
    )
    gaps_s = np.diff(found.adjusted.solution.problem.states.timestamps_ns) * 1e-9
    assert (gaps_s > 10).sum() == 2
    errors = evaluate_calibration(found.calibration, rig_in_frame(simulated.recording.true_rig, "imu"))
    for camera in errors.cameras.values():
        assert camera.rotation_error_deg < 0.3
        assert camera.nees / camera.nees_dof < 3.0
