"""Did a camera move while the recording was made that it is calibrated from?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rigwake.calibration import Calibration
from rigwake.cameras.protocol import CameraModel
from rigwake.monitor.innovations import belief_of
from rigwake.monitor.judge import judge_blocks
from rigwake.monitor.rig_motion import rig_motion
from rigwake.monitor.score import BLOCK_S, block_starts, score_blocks
from rigwake.monitor.thresholds import Thresholds
from rigwake.monitor.vessel_rig import prepare_rig
from rigwake.recording import Recording
from rigwake.tracks import Tracks

_FEWEST_BLOCKS = 3
_PAIRS_S = 0.33  # between the starts of pairs: calibrate has done the work already, this is a check


def knocks_inside(
    calibration: Calibration,
    recording: Recording,
    tracks: Mapping[str, Tracks],
    thresholds: Thresholds | None = None,
) -> tuple[str, ...]:
    """Cameras that turned on their mounts in the recording that `calibration` is made from, a sentence for each.

    tracks: by camera; bearings are taken anew from the calibration's lenses. The statistic is that of `monitor`,
    against a calibration that is between before and after. Less than half a minute shows nothing. Raises as
    `prepare_rig`.
    """
    thresholds = thresholds or Thresholds()
    monitored = prepare_rig(calibration, recording, is_its_own=True)
    known = {
        name: _with_bearings(tracks[name], camera.model)
        for name, camera in monitored.rig.cameras.items()
        if camera.model is not None
    }
    motion = rig_motion(monitored.imu, monitored.gnss, monitored.calibration.antenna_rig)
    starts = block_starts(known, monitored.rig, motion)
    if len(starts) < _FEWEST_BLOCKS:
        return ()
    steps = [np.diff(own.timestamps_ns) for own in known.values() if len(own.timestamps_ns) > 1]
    stride = max(round(_PAIRS_S * 1e9 / float(np.median(np.concatenate(steps)))), 1)
    scores = score_blocks(known, monitored.rig, motion, starts_ns=starts, stride=stride)
    belief = belief_of(monitored.calibration, scores.cameras, thresholds)
    sentences = []
    for alarm in judge_blocks(scores, belief, monitored.places, thresholds).alarms:
        change = alarm.change
        if not alarm.camera or change is None or change.block == 0:
            continue
        seconds = change.block * BLOCK_S
        turned = f"{alarm.camera}: it turned on its mount by about {change.size_deg:.2f} deg"
        if change.kind == "ramp":
            sentences.append(
                f"{turned}, slowly, from {seconds:.0f} s after the start to the end; the calibration is between. "
                "Fasten it, and record again."
            )
            continue
        sentences.append(
            f"{turned} {seconds:.0f} to {seconds + BLOCK_S:.0f} s after the start; the calibration is between before "
            "and after. Calibrate from the part before or after it: --start, --duration."
        )
    return tuple(sentences)


def _with_bearings(tracks: Tracks, model: CameraModel) -> Tracks:
    bearings, valid = model.unproject(tracks.pixels)
    return replace(tracks, bearings_cam=np.where(valid[:, None], bearings, tracks.bearings_cam))
