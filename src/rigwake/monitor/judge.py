"""From scores of blocks to what is said of every camera: the whole decision, without pictures or files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from rigwake._types import Array
from rigwake.monitor.blame import Explanation, bent_pictures, explain, strong_bend, support
from rigwake.monitor.change_detection import (
    BlockStatistics,
    Change,
    fit_change,
    glr,
    likelihood_ratios,
    shift_std_m,
)
from rigwake.monitor.innovations import Belief, Innovations, innovations, innovations_of_motion, with_offsets
from rigwake.monitor.pair_kernels import MOUNTING
from rigwake.monitor.score import BlockScores
from rigwake.monitor.states import CameraState, Standing, next_standing
from rigwake.monitor.thresholds import Thresholds


@dataclass(frozen=True, eq=False)
class Alarm:
    """An alarm: in which block, from which block on, and what explains it, the likeliest first.

    camera: that is blamed, "" if none is. change: of the blamed camera.
    """

    block: int
    since: int
    camera: str
    explanations: tuple[Explanation, ...]
    change: Change | None = None

    @property
    def words(self) -> str:
        """What happened, in words."""
        best, others = self.explanations[0], self.explanations[1:]
        if self.camera or best.cause in ("imu", "imu clock", "clock", "translation", "picture"):
            return best.words
        near = [e.words for e in others if e.evidence > best.evidence - 3.0][:2]
        return " or ".join([best.words, *near])


@dataclass(frozen=True, eq=False)
class Judgement:
    """standings: per block and camera. statistics: per block and camera. std_deg: (B, C, 3) about each camera's axes.

    step: (B, C, 3), step_std: (B, C, 3) rotations by single blocks, rad, rig axes. alarms: in the order of time.
    shift_std_m: (C, 3) of a shift over the last blocks, rig axes; infinite where the motion does not show it.
    """

    scores: BlockScores
    standings: tuple[tuple[CameraState, ...], ...]
    statistics: BlockStatistics
    step: Array
    step_std: Array
    alarms: tuple[Alarm, ...]
    shift_std_m: Array

    def alarm_of(self, camera: str) -> Alarm | None:
        """The alarm that a camera is blamed for, or that its words are about."""
        for alarm in self.alarms:
            if alarm.camera == camera or alarm.explanations[0].camera == camera:
                return alarm
        return None


def judge_cues(
    together: BlockScores,
    alone: BlockScores,
    belief: Belief,
    places: Mapping[str, Array],
    thresholds: Thresholds,
    axes: Array | None = None,
) -> Judgement:
    """As `judge_blocks` of the motion alone; all cues together may raise its first alarm sooner.

    together: `fuse` of all cues, alone: of the ego-motion. Cues that compare cameras with each other blame none by
    themselves: the motion must support it. What follows that alarm is judged by the motion alone, since what two
    cameras saw is lost, and in part wrong, once one of them turned.
    """
    found = innovations(together, with_offsets(belief, together.H.shape[1], thresholds), thresholds)
    motion = innovations_of_motion(alone, belief, thresholds)
    sooner = _joint_alarm(found, motion, places, thresholds)
    judgement = judge_blocks(alone, belief, places, thresholds, axes, sooner=sooner)
    return replace(judgement, shift_std_m=shift_std_m(found, thresholds))


def judge_blocks(
    scores: BlockScores,
    belief: Belief,
    places: Mapping[str, Array],
    thresholds: Thresholds,
    axes: Array | None = None,
    *,
    sooner: Alarm | None = None,
) -> Judgement:
    """Detection, blame and states of all cameras over all blocks. places: (3,) of the cameras on the rig.

    sooner: an alarm that takes the place of the first one if it is earlier.

    What was explained (a camera that moved, a clock that jumped) becomes unknown from the beginning, and the rest is
    judged again: one moved camera must not make others look moved.
    """
    names = scores.cameras
    alarms: list[Alarm] = []
    known, found = scores, innovations_of_motion(scores, belief, thresholds)
    statistics = glr(found, thresholds, axes)
    first_found, merged = found, statistics
    explained: set[str] = set()
    for _ in range(len(names) + 2):
        alarm = _first_alarm(found, statistics, places, thresholds, explained)
        if not alarms and sooner is not None and (alarm is None or sooner.block < alarm.block):
            alarm = sooner
        if alarm is None:
            break
        alarms.append(alarm)
        best = alarm.explanations[0]
        if best.cause == "picture" or (not alarm.camera and best.cause == "rotation"):
            explained |= {
                e.camera for e in alarm.explanations if e.evidence > best.evidence - thresholds.margin
            }
            explained.add(best.camera)
            break
        explained.add(best.camera)
        known = _released(known, best)
        found = innovations_of_motion(known, belief, thresholds)
        statistics = glr(found, thresholds, axes)
        merged = _merged(merged, statistics, names, explained)
    step, step_std = _steps(first_found)
    standings = _standings(merged, alarms, names, thresholds)
    seen = shift_std_m(first_found, thresholds)
    return Judgement(scores, standings, merged, step, step_std, tuple(alarms), seen)


def _first_alarm(
    found: Innovations,
    statistics: BlockStatistics,
    places: Mapping[str, Array],
    thresholds: Thresholds,
    explained: set[str],
) -> Alarm | None:
    """The earliest alarm that a cause explains; where causes stay close, the wait is a few blocks."""
    names = found.scores.cameras
    value = statistics.value.copy()
    for name in explained - {""}:
        value[:, names.index(name)] = 0.0
    over = np.flatnonzero((value >= thresholds.alarm).any(axis=1))
    begin = int(over[0]) if len(over) else len(value)
    whole = None if "" in explained else _whole_rig_alarm(found, places, thresholds, begin)
    if whole is not None:
        return whole
    if not len(over):
        return None
    usual = bent_pictures(found, 0, max(begin - 2, 0))
    alarm = None
    for block in range(begin, min(begin + thresholds.patience + 1, len(value))):
        worst = int(np.argmax(value[block]))
        if value[block, worst] < thresholds.suspect:
            break
        since, steady = int(statistics.first[block, worst]), bool(statistics.steady[block, worst])
        explanations = explain(found, since, block, places, steady=steady)
        bent = strong_bend(bent_pictures(found, since, block), usual)
        best = explanations[0]
        if bent and best.camera == bent:
            picture = replace(best, cause="picture", camera=bent)
            return Alarm(block, since, "", (picture, *explanations))
        clear = best.evidence - explanations[1].evidence >= thresholds.margin
        if clear and best.cause == "rotation":
            change = fit_change(found, names.index(best.camera), len(value) - 1)
            return Alarm(block, change.block, best.camera, tuple(explanations), change)
        if clear:
            return Alarm(block, since, "", tuple(explanations))
        alarm = Alarm(block, since, "", tuple(explanations))
    return alarm


def joint_claim(
    found: Innovations,
    alone: Innovations,
    statistics: BlockStatistics,
    block: int,
    places: Mapping[str, Array],
    thresholds: Thresholds,
) -> list[Explanation]:
    """What all cues together say of the camera that turned or shifted by a block, the likeliest first; empty if it is
    not clear, or the motion alone does not support it.

    found, statistics: of all cues together; alone: of the motion.
    """
    worst = int(np.argmax(statistics.value[block]))
    since, steady = int(statistics.first[block, worst]), bool(statistics.steady[block, worst])
    explanations = explain(found, since, block, places, steady=steady)
    best = explanations[0]
    if best.cause not in ("rotation", "translation"):
        return []
    if best.evidence - explanations[1].evidence < thresholds.margin:
        return []
    supported = support(best, explain(alone, since, block, places, steady=steady)) >= thresholds.support
    return explanations if supported else []


def _joint_alarm(
    found: Innovations, alone: Innovations, places: Mapping[str, Array], thresholds: Thresholds
) -> Alarm | None:
    """The first alarm of all cues together."""
    statistics = likelihood_ratios(found, thresholds)
    for block in np.flatnonzero((statistics.value >= thresholds.alarm).any(axis=1)).tolist():
        explanations = joint_claim(found, alone, statistics, block, places, thresholds)
        if not explanations:
            continue
        best = explanations[0]
        if best.cause == "translation":
            since = int(statistics.first[block, int(np.argmax(statistics.value[block]))])
            return Alarm(block, since, "", tuple(explanations))
        change = fit_change(found, found.scores.cameras.index(best.camera), len(found.scores) - 1)
        return Alarm(block, change.block, best.camera, tuple(explanations), change)
    return None


def _whole_rig_alarm(
    found: Innovations, places: Mapping[str, Array], thresholds: Thresholds, before: int
) -> Alarm | None:
    """An IMU that turned or lost its clock moves all cameras alike, so that none disagrees with the others: the first
    block at which that explains more than an alarm takes, and more than any single camera would."""
    for block in range(thresholds.shortest - 1, before):
        for length in (2, 4, 8, 12):
            since = block - length + 1
            if since < 0 or length > thresholds.longest or not found.scores.rows[since].any():
                continue
            wide = explain(found, since, block, places, steady=False, whole_rig=True)[0]
            spread = float(found.spread[block].max())
            if 2 * wide.evidence < thresholds.alarm * spread:
                continue
            explanations = explain(found, since, block, places, steady=False)
            if (
                explanations[0].evidence - explanations[1].evidence >= thresholds.margin
                and not explanations[0].camera
            ):
                return Alarm(block, since, "", tuple(explanations))
    return None


def _released(scores: BlockScores, explanation: Explanation) -> BlockScores:
    """Scores in which what was explained is unknown: eliminated from every block."""
    size = scores.H.shape[1]
    out: list[int] = []
    for k, name in enumerate(scores.cameras):
        if explanation.camera in (name, ""):
            at = MOUNTING * k
            turned = explanation.cause in ("rotation", "imu", "picture")
            moved = explanation.cause in ("rotation", "translation", "imu", "picture")
            out += range(at, at + 3) if turned else ()
            out += range(at + 3, at + 6) if moved else ()
            out += [at + 6] if explanation.cause in ("clock", "imu clock", "rotation", "picture") else []
    if explanation.cause == "imu":  # all cameras together, not each alone
        P = np.zeros((size, 6))
        for k in range(len(scores.cameras)):
            P[MOUNTING * k : MOUNTING * k + 6] = np.eye(6)
    elif explanation.cause == "imu clock":
        P = np.zeros((size, 1))
        P[6::MOUNTING] = 1.0
    else:
        P = np.eye(size)[:, out]
    H, g = scores.H.copy(), scores.g.copy()
    for b in range(len(scores)):
        inner = P.T @ H[b] @ P
        spread = np.linalg.pinv(inner, rcond=1e-10, hermitian=True) @ (P.T @ np.column_stack([H[b], g[b]]))
        reduced = np.column_stack([H[b], g[b]]) - H[b] @ P @ spread
        H[b], g[b] = (reduced[:, :-1] + reduced[:, :-1].T) / 2, reduced[:, -1]
    return replace(scores, H=H, g=g)


def _merged(
    before: BlockStatistics, after: BlockStatistics, names: tuple[str, ...], explained: set[str]
) -> BlockStatistics:
    """Statistics after a release, but those of the explained cameras as they were."""
    kept = np.array([name in explained for name in names])
    return BlockStatistics(
        np.where(kept, before.value, after.value),
        np.where(kept, before.first, after.first),
        np.where(kept, before.steady, after.steady),
        np.where(kept[:, None], before.std_deg, after.std_deg),
    )


def _steps(found: Innovations) -> tuple[Array, Array]:
    scores = found.scores
    shape = len(scores), len(scores.cameras), 3
    step, std = np.full(shape, np.nan), np.full(shape, np.nan)
    for k in range(shape[0]):
        for c in range(shape[1]):
            if scores.rows[k, c] and scores.H[k].any():
                step[k, c], covariance = found.step(c, k)
                std[k, c] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return step, std


def _standings(
    statistics: BlockStatistics, alarms: list[Alarm], names: tuple[str, ...], thresholds: Thresholds
) -> tuple[tuple[CameraState, ...], ...]:
    standing = {name: Standing() for name in names}
    blamed_at = {alarm.camera: alarm.block for alarm in alarms if alarm.camera}
    suspected_at = {alarm.explanations[0].camera: alarm.block for alarm in alarms if not alarm.camera}
    # beside a bent picture nothing can be told of the others from these scores
    bent_at = min(
        (a.block for a in alarms if a.explanations[0].cause == "picture"), default=len(statistics.value)
    )
    rows = []
    for k in range(len(statistics.value)):
        for c, name in enumerate(names):
            value = float(statistics.value[k, c])
            blamed = name in blamed_at and k >= blamed_at[name]
            if blamed and k == blamed_at[name]:
                value = max(value, thresholds.alarm)
            suspected = (name in suspected_at and k >= suspected_at[name]) or (
                "" in suspected_at and k >= suspected_at[""]
            )
            if suspected and not blamed:
                value = max(value, thresholds.suspect)
            elif k >= bent_at - 1 and not blamed:
                value = 0.0
            standing[name] = next_standing(
                standing[name],
                value,
                blamed=blamed,
                observable=bool((statistics.std_deg[k, c] <= thresholds.observable_deg).all()),
                thresholds=thresholds,
            )
        rows.append(tuple(standing[name].state for name in names))
    return tuple(rows)
