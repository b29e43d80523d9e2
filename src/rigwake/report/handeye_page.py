"""The page of a hand-eye calibration: mountings, aligned angular speeds, residuals over time, paths laid over each
other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from rigwake._types import Array
from rigwake.calibration import CalibratedCamera
from rigwake.errors import EstimationError
from rigwake.geometry import so3
from rigwake.geometry.align import align_points
from rigwake.geometry.interpolate import interpolate
from rigwake.handeye.handeye_problem import HandeyeResult, in_one_unit
from rigwake.plausibility.handeye_fit import finding_of
from rigwake.plausibility.values import SensorCheck
from rigwake.report.charts import Series, line_chart, top_view
from rigwake.report.extrinsics import number, plus_minus, time_offset
from rigwake.report.html_page import (
    card,
    figure,
    html_page,
    legend,
    listing,
    note,
    side_by_side,
    table,
    verdict,
)
from rigwake.report.motion_figures import thin
from rigwake.report.strip_charts import interval_chart, rig_from_above
from rigwake.sync import angular_speed
from rigwake.trajectory import Trajectory

_STEP_S = 1.0  # motions are compared over so long: shorter ones drown in the noise of the poses
_MOST_STEPS = 600


def handeye_page(
    result: HandeyeResult,
    reference: Trajectory,
    members: Sequence[Trajectory],
    checks: Sequence[SensorCheck] = (),
) -> str:
    """One HTML page. members: the trajectories that went in beside the reference, by the names in `result`."""
    in_metres = (in_one_unit(reference, member)[0] for member in members)  # as the estimate saw them
    by_name = {m.name: m for m in in_metres if m.name in result.members}
    observable = [n for n, camera in result.members.items() if camera.has_figures]
    tone = "lost" if not observable else "usable" if len(observable) < len(result.members) else "good"
    open_parts = [f"{d.words}. {d.remedy}" for c in result.members.values() for d in c.unobservable]
    return html_page(
        f"Hand-eye calibration in {result.reference}",
        [
            verdict(tone, f"{len(observable)} of {len(result.members)} mountings observable", open_parts),
            _mountings(result),
            card("Do the clocks agree?", *_speeds(result, reference, by_name)),
            card(
                "Do the motions agree?",
                *_residuals(result, reference, by_name),
                listing(map(finding_of, checks)),
            ),
            card("Paths from above", *_paths(result, reference, by_name)),
        ],
        f"Reference {result.reference}, {reference.duration_s:.0f} s. Noise: {result.noise}. {result.steps} steps, "
        f"{result.down_weighted} of them down-weighted as outliers.",
    )


def _mountings(result: HandeyeResult) -> Markup:
    rows = [_row(camera) for camera in result.members.values()]
    head = [
        "member",
        *(f"rotation {axis}, °" for axis in "xyz"),
        "x, mm",
        "y, mm",
        "z, mm",
        "offset, ms",
        "scale",
    ]
    drawn = rig_from_above(
        f"Mountings in {result.reference} from above",
        [{name: camera.rig_from_cam for name, camera in result.members.items()}],
    )
    return card(
        "Mountings",
        table("Mountings", head, rows),
        note(
            f"Rotation vector and position of each member in the axes of {result.reference}, ± one standard deviation."
        ),
        figure(
            drawn,
            f"From above: x to the right, y up; the cross is {result.reference}, lines point along each z.",
        ),
    )


def _row(camera: CalibratedCamera) -> list[str]:
    rotation = camera.rig_from_cam.rotation
    turn = np.rad2deg(so3.log(rotation)) if np.isfinite(rotation).all() else np.full(3, np.nan)
    cells = [camera.name]
    cells += [
        f"{number(x, 3)} {plus_minus(s, '')}".strip()
        for x, s in zip(turn, camera.std_rotation_deg, strict=True)
    ]
    cells += [
        f"{number(1e3 * x, 1)} {plus_minus(1e3 * s, '')}".strip()
        for x, s in zip(camera.rig_from_cam.translation, camera.std_translation_m, strict=True)
    ]
    offset = time_offset(camera)
    cells.append(f"{offset.text} {offset.std}".strip())
    scale = camera.scale
    cells.append("–" if scale is None or not np.isfinite(scale) else f"{scale:.4f}")
    return cells


def _offset_ns(camera: CalibratedCamera) -> int:
    """What to add to a member's stamps to have those of the reference."""
    offset = camera.time_offset_s
    return 0 if offset is None or not np.isfinite(offset) else round(offset * 1e9)


def _stride(trajectory: Trajectory, seconds: float) -> int:
    if len(trajectory) < 2:
        return 1
    period = float(np.median(np.diff(trajectory.timestamps_ns))) * 1e-9
    return int(np.clip(round(seconds / max(period, 1e-6)), 1, len(trajectory) - 1))


def _speeds(result: HandeyeResult, reference: Trajectory, members: dict[str, Trajectory]) -> list[Markup]:
    """Angular speeds on the clock of the reference: equal for every body of one rig, whatever its mounting."""
    start = int(reference.timestamps_ns[0])
    series = []
    for k, (name, one) in enumerate({result.reference: reference, **members}.items()):
        if len(one) < 3:
            continue
        shift = _offset_ns(result.members[name]) if k else 0
        times, speed = angular_speed(one, _stride(one, 0.4))
        kept = thin(len(times))
        at = times[kept] + (int(one.timestamps_ns[0]) + shift - start) * 1e-9
        inside = (at >= 0) & (at <= reference.duration_s)
        series.append(Series(name, at[inside], np.rad2deg(speed[kept][inside]), k))
    chart = line_chart(
        "Angular speed of every body", "time on the clock of the reference, s", "deg/s", series
    )
    offsets = {
        name: (
            1e3 * float(c.time_offset_s),
            1e3 * float(np.nan if c.time_offset_std_s is None else c.time_offset_std_s),
        )
        for name, c in result.members.items()
        if c.time_offset_s is not None and np.isfinite(c.time_offset_s) and abs(c.time_offset_s) < 1.0
    }
    return [
        legend([result.reference, *members]),
        side_by_side(
            figure(chart, "Angular speeds, after the time offsets: the lines must lie on each other."),
            figure(
                interval_chart("Time offsets", "offset, ms", offsets),
                "Time offsets, t_reference = t_member + offset; those below a second. Thick bar: one standard "
                "deviation; thin bar: three.",
            ),
        ),
    ]


def _residuals(result: HandeyeResult, reference: Trajectory, members: dict[str, Trajectory]) -> list[Markup]:
    start = int(reference.timestamps_ns[0])
    turns, ways = [], []
    for k, (name, member) in enumerate(members.items(), start=1):
        found = motion_residuals(result, reference, member)
        if found is None:
            continue
        stamps, errors = found
        at = (stamps - start) * 1e-9
        turns.append(Series(name, at, np.rad2deg(np.linalg.norm(errors[:, :3], axis=1)), k, is_dots=True))
        ways.append(Series(name, at, 1e3 * np.linalg.norm(errors[:, 3:], axis=1), k, is_dots=True))
    return [
        side_by_side(
            figure(
                line_chart("Disagreement in rotation", "time, s", "deg", turns),
                f"Rotation over {_STEP_S:g} s: member against reference through the mounting.",
            ),
            figure(
                line_chart("Disagreement in translation", "time, s", "mm", ways),
                f"Translation over {_STEP_S:g} s, where the mounting and the scale are observable.",
            ),
        )
    ]


def motion_residuals(
    result: HandeyeResult, reference: Trajectory, member: Trajectory
) -> tuple[np.ndarray, Array] | None:
    """Stamps (N,) of the reference's clock and `log(B^-1 X^-1 A X)` (N, 6) of motions A, B over one second.

    The translation is NaN where the scale of the member's segment is unobservable. None where nothing overlaps.
    Along directions that the motion leaves unobservable the raw estimate serves: any value fits there.
    """
    X, shift = result.ref_from_members[member.name], _offset_ns(result.members[member.name])
    own = member.timestamps_ns
    on_reference = own + shift
    stride = _stride(member, _STEP_S)
    first = np.arange(0, len(own) - stride)
    first = first[thin(len(first), _MOST_STEPS)] if len(first) else first
    assert member.segment_ids is not None
    assert reference.segment_ids is not None
    begin, end = on_reference[first], on_reference[first + stride]
    inside = (begin >= reference.timestamps_ns[0]) & (end <= reference.timestamps_ns[-1])
    inside &= member.segment_ids[first] == member.segment_ids[first + stride]
    before, after = (
        np.searchsorted(reference.timestamps_ns, s).clip(0, len(reference) - 1) for s in (begin, end)
    )
    inside &= reference.segment_ids[before] == reference.segment_ids[after]
    first, begin, end = first[inside], begin[inside], end[inside]
    if not len(first) or not np.isfinite(X.matrix).all():
        return None
    A = (
        interpolate(reference.timestamps_ns, reference.world_from_body, begin).inverse()
        * interpolate(reference.timestamps_ns, reference.world_from_body, end)
    )  # fmt: skip
    B = member.world_from_body[first].inverse() * member.world_from_body[first + stride]
    scales = _scales(result, member)[member.segment_ids[first]]
    B = type(B)(B.rotation, B.translation * scales[:, None])
    errors = (B.inverse() * X.inverse() * A * X).log()
    return begin, np.asarray(errors)


def _scales(result: HandeyeResult, member: Trajectory) -> Array:
    """Metres per unit of every segment; NaN where unobservable, 1 where none was estimated."""
    assert member.segment_ids is not None
    count = int(member.segment_ids.max()) + 1
    found = np.asarray(result.scales[member.name], np.float64).reshape(-1, 2)
    if not len(found):
        return np.ones(count)
    return found[np.minimum(np.arange(count), len(found) - 1), 0]


def _paths(result: HandeyeResult, reference: Trajectory, members: dict[str, Trajectory]) -> list[Markup]:
    """The reference's path, and where each member and its mounting say that the reference was."""
    kept = thin(len(reference))
    path = reference.world_from_body.translation[kept]
    series, missing = [Series(result.reference, path[:, 0], path[:, 1], 0)], []
    for k, (name, member) in enumerate(members.items(), start=1):
        points = _reference_by(result, reference, member)
        if points is None:
            missing.append(name)
        else:
            series.append(Series(name, points[:, 0], points[:, 1], k))
    left_out = note(f"Left out, because its mounting or scale is unobservable: {', '.join(missing)}.")
    return [
        legend([result.reference, *members]),
        figure(
            top_view("Paths from above", series[::-1]),
            f"The path of {result.reference}, and what each member says it was, laid over it as a whole. The square is "
            "the start.",
        ),
        left_out if missing else Markup(""),
    ]


def _reference_by(result: HandeyeResult, reference: Trajectory, member: Trajectory) -> Array | None:
    """(N, 3) positions of the reference by a member's longest segment, in the reference's world."""
    assert member.segment_ids is not None
    X, shift = result.members[member.name].rig_from_cam, _offset_ns(result.members[member.name])
    longest = int(np.bincount(member.segment_ids).argmax())
    scale = _scales(result, member)[longest]
    if not np.isfinite(X.matrix).all() or not np.isfinite(scale):
        return None
    stamps = member.timestamps_ns + shift
    inside = (member.segment_ids == longest) & (stamps >= reference.timestamps_ns[0])
    rows = np.flatnonzero(inside & (stamps <= reference.timestamps_ns[-1]))
    rows = rows[thin(len(rows))] if len(rows) else rows
    if len(rows) < 3:
        return None
    poses = member.world_from_body[rows]
    own = scale * poses.translation + np.einsum("nij,j->ni", poses.rotation, X.inverse().translation)
    target = interpolate(reference.timestamps_ns, reference.world_from_body, stamps[rows]).translation
    try:
        laid = align_points(own, target, "se3").target_from_source
    except EstimationError:  # on one line or in one place
        return None
    return np.asarray(own @ laid.rotation.T + laid.translation)
