"""Places seen before: tracks of the same point, broken by an outage or by time, become one track again.

A vocabulary of binary descriptors is learnt from the recording itself; frames with similar word histograms are
compared descriptor by descriptor, and a pair counts if one pose explains its matches (PnP on the map's points). What
belongs together gets one track number. A pose graph in Sim(3) spreads the error of the loop over the path
(`closed_path`); adjusted again from there, the joined tracks agree.

Sources: Sivic and Zisserman, *Video Google* (2003); Galvez-Lopez and Tardos, *Bags of binary words* (2012).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rigwake._types import Array, Indices
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import EstimationError
from rigwake.geometry.pnp import absolute_pose
from rigwake.geometry.se3 import SE3
from rigwake.odometry.indexed_tracks import radians_per_pixel
from rigwake.odometry.pose_graph import Edges, Similarities, optimise_pose_graph
from rigwake.odometry.result import OdometryResult
from rigwake.recording import CameraStream
from rigwake.tracks import Tracks

# what odometry may be wrong by from frame to frame, and a recognised place: rotation, share of length, log of scale
_STEP_STD = (1e-3, 0.01, 3e-3)
_LOOP_STD = (2e-3, 2e-3, 0.02)


@dataclass(frozen=True)
class LoopOptions:
    """Options of place recognition.

    interval_s: between frames that are described. min_gap_s: places are compared when seen this far apart.
    words: size of the vocabulary. candidates: most similar frames that are verified per frame.
    max_hamming, max_ratio: of descriptor matches. min_matches: inliers of a verified pair. gate_px: of PnP.
    """

    interval_s: float = 0.5
    min_gap_s: float = 3.0
    words: int = 128
    candidates: int = 4
    max_hamming: int = 50
    max_ratio: float = 0.8
    min_matches: int = 15
    gate_px: float = 2.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Loops:
    """Pairs of frames that show the same place, (P, 2), and pairs of track ids that are the same point, (K, 2).

    world_from_second: (P,) where each pair's second frame is by the points that the first one knew, with the unit
    of length that the map has around the second, in units of the map around the first.
    """

    frames: Indices
    track_ids: Indices
    world_from_second: Similarities


@dataclass(frozen=True, eq=False)
class _Described:
    """Descriptors (N, 32) of observations: rows of the tracks (N,), sorted by frame."""

    rows: Indices
    descriptors: NDArray[np.uint8]


def find_loops(
    stream: CameraStream,
    tracks: Tracks,
    camera: CameraModel,
    visual: OdometryResult,
    options: LoopOptions | None = None,
) -> Loops:
    """Frames of the recording that see a place again, verified by geometry; empty if there are none."""
    options = options or LoopOptions()
    frames = _spaced(tracks, visual, options.interval_s)
    described = _describe(stream, tracks, visual, frames)
    none = Loops(np.empty((0, 2), np.int64), np.empty((0, 2), np.int64), Similarities.exp(np.empty((0, 7))))
    if len(described.rows) < options.words:
        return none
    frame_of = tracks.frame_indices[described.rows]
    similarity = _similarity(described, frame_of, frames, options)
    stamps = tracks.timestamps_ns[frames]
    far = np.abs(stamps[:, None] - stamps[None]) >= options.min_gap_s * 1e9
    rng = np.random.default_rng(options.seed)
    points = dict(zip(visual.landmarks.track_ids.tolist(), visual.landmarks.points_world, strict=True))
    pairs, same, placed = [], [], []
    for i, frame in enumerate(frames):
        earlier = np.flatnonzero(far[i] & (np.arange(len(frames)) < i))
        for j in earlier[np.argsort(-similarity[i, earlier], kind="stable")[: options.candidates]]:
            rows_new, rows_old = (described.rows[frame_of == f] for f in (frame, frames[j]))
            new, old = (described.descriptors[frame_of == f] for f in (frame, frames[j]))
            a, b = _matches(new, old, options)
            found = _verified(tracks, camera, points, rows_new[a], rows_old[b], options, rng)
            if found is not None:
                ids, world_from_cam = found
                pairs.append((int(frames[j]), int(frame)))
                same.append(ids)
                placed.append((world_from_cam, _unit(visual, points, int(frame), ids, world_from_cam)))
    if not pairs:
        return none
    transforms, units = zip(*placed, strict=True)
    world_from_second = Similarities(
        np.stack([t.rotation for t in transforms]),
        np.stack([t.translation for t in transforms]),
        np.array(units),
    )
    return Loops(np.array(pairs, dtype=np.int64), np.concatenate(same), world_from_second)


def _unit(
    visual: OdometryResult, points: dict[int, Array], frame: int, ids: Indices, world_from_cam: SE3
) -> float:
    """How many units of the old points' map the new points' unit is: the median ratio of ranges from the frame."""
    centre = visual.trajectory.world_from_body.translation[np.searchsorted(visual.frame_indices, frame)]
    ratios = [
        np.linalg.norm(points[old] - world_from_cam.translation) / np.linalg.norm(points[new] - centre)
        for old, new in ids.tolist()
        if new in points
    ]
    return float(np.median(ratios)) if ratios else 1.0


def closed_path(visual: OdometryResult, loops: Loops) -> tuple[Indices, SE3]:
    """Frames and their `world_from_cam` after a pose graph in Sim(3) has spread what the loops reveal over the path.

    Segments that loops connect share one world; frames of others are left out. Raises EstimationError if the graph
    does not converge.
    """
    path = visual.trajectory.world_from_body
    segments = visual.trajectory.segment_ids
    assert segments is not None
    nodes = Similarities.from_transforms(path)
    before = np.flatnonzero(np.diff(segments) == 0)
    own = nodes[before].inverse() * nodes[before + 1]
    first, second = np.searchsorted(visual.frame_indices, loops.frames).T
    seen = nodes[first].inverse() * loops.world_from_second
    step = np.linalg.norm(own.translation, axis=1)
    step = np.maximum(step, np.median(step))
    ranges = np.linalg.norm(visual.landmarks.points_world - path.translation.mean(axis=0), axis=1)
    std = np.concatenate(
        [_edge_std(_STEP_STD, step), _edge_std(_LOOP_STD, np.full(len(first), np.median(ranges)))]
    )
    measured = [
        np.concatenate([getattr(own, name), getattr(seen, name)])
        for name in ("rotation", "translation", "scale")
    ]
    edges = Edges(
        np.concatenate([before, first]),
        np.concatenate([before + 1, second]),
        Similarities(*measured),
        std,
        np.repeat([False, True], [len(before), len(first)]),
    )
    closed, member = optimise_pose_graph(nodes, edges)
    return visual.frame_indices[member], SE3(closed.rotation[member], closed.translation[member])


def _edge_std(relative: tuple[float, float, float], lengths: Array) -> Array:
    """(E, 7) of edges: radians, a fraction of the length, and the log of scale."""
    rotation, translation, scale = relative
    columns = np.repeat([rotation, 0.0, scale], [3, 3, 1]) * np.ones((len(lengths), 1))
    columns[:, 3:6] = translation * lengths[:, None]
    return columns


def _spaced(tracks: Tracks, visual: OdometryResult, interval_s: float) -> Indices:
    stamps = tracks.timestamps_ns[visual.frame_indices]
    _, first = np.unique((stamps - stamps[0]) // round(interval_s * 1e9), return_index=True)
    return np.asarray(visual.frame_indices[first])


def _describe(stream: CameraStream, tracks: Tracks, visual: OdometryResult, frames: Indices) -> _Described:
    """Upright ORB descriptors at the inliers of these frames: a boat seldom lies on its side."""
    orb = cv2.ORB.create()
    in_stream = np.searchsorted(stream.timestamps_ns, tracks.timestamps_ns[frames])
    rows, descriptors = [], []
    for frame, image in zip(frames, stream.frames(in_stream), strict=False):
        of_frame = np.flatnonzero(visual.inliers & (tracks.frame_indices == frame))
        keypoints = [
            cv2.KeyPoint(float(x), float(y), 31.0, 0.0, 1.0, 0, k)
            for k, (x, y) in zip(of_frame.tolist(), tracks.pixels[of_frame], strict=True)
        ]
        kept, found = orb.compute(image.image, keypoints)
        if found is not None and len(kept):
            rows.append(np.array([point.class_id for point in kept], dtype=np.int64))
            descriptors.append(found)
    if not rows:
        return _Described(np.empty(0, np.int64), np.empty((0, 32), np.uint8))
    return _Described(np.concatenate(rows), np.concatenate(descriptors))


def _similarity(described: _Described, frame_of: Indices, frames: Indices, options: LoopOptions) -> Array:
    """(F, F) cosine of tf-idf word histograms; the words are k-means centres of the recording's descriptors."""
    bits = np.unpackbits(described.descriptors, axis=1).astype(np.float32)
    rng = np.random.default_rng(options.seed)
    sample = bits[rng.permutation(len(bits))[: 40 * options.words]]
    cv2.setRNGSeed(options.seed)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, 10, 0.0)
    _, _, centres = cv2.kmeans(sample, options.words, None, stop, 1, cv2.KMEANS_PP_CENTERS)
    words = np.argmin((centres**2).sum(axis=1) - 2 * bits @ centres.T, axis=1)
    histogram = np.zeros((len(frames), options.words))
    np.add.at(histogram, (np.searchsorted(frames, frame_of), words), 1.0)
    idf = np.log(len(frames) / np.maximum((histogram > 0).sum(axis=0), 1))
    weighted = histogram * idf
    weighted /= np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-12)
    return np.asarray(weighted @ weighted.T)


def _matches(
    first: NDArray[np.uint8], second: NDArray[np.uint8], options: LoopOptions
) -> tuple[Indices, Indices]:
    """Mutually nearest descriptors that are near, and nearer than the second best."""
    if len(first) < 2 or len(second) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(second, first)}
    kept = [
        (best.queryIdx, best.trainIdx)
        for best, other in matcher.knnMatch(first, second, k=2)
        if best.distance <= options.max_hamming
        and best.distance <= options.max_ratio * other.distance
        and back[best.trainIdx] == best.queryIdx
    ]
    pairs = np.array(kept, dtype=np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _verified(
    tracks: Tracks,
    camera: CameraModel,
    points: dict[int, Array],
    rows_new: Indices,
    rows_old: Indices,
    options: LoopOptions,
    rng: np.random.Generator,
) -> tuple[Indices, SE3] | None:
    """(K, 2) ids of tracks (old, new) that are one point, and the new view's place: PnP on the old tracks' points
    agrees with them."""
    ids_old, ids_new = tracks.track_ids[rows_old], tracks.track_ids[rows_new]
    usable = np.array([int(i) in points for i in ids_old], dtype=bool) & (ids_old != ids_new)
    if usable.sum() < options.min_matches:
        return None
    ids_old, ids_new, bearings = ids_old[usable], ids_new[usable], tracks.bearings_cam[rows_new[usable]]
    world = np.stack([points[int(i)] for i in ids_old])
    rad_per_px = radians_per_pixel(camera, bearings)
    try:
        pose = absolute_pose(
            world, bearings, max_angles=options.gate_px * rad_per_px, angle_stds=0.5 * rad_per_px, rng=rng
        )
    except EstimationError:
        return None
    if pose.inliers.sum() < options.min_matches:
        return None
    return np.stack([ids_old[pose.inliers], ids_new[pose.inliers]], axis=1), pose.world_from_cam


def joined_tracks(tracks: Tracks, same_ids: Indices) -> Tracks:
    """Tracks in which each group of ids that are the same point has one id (its smallest); same_ids: (K, 2).

    Where that would put a point twice into one frame, the first observation stays.
    """
    parent: dict[int, int] = {}

    def root(i: int) -> int:
        while parent.setdefault(i, i) != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for a, b in same_ids.tolist():
        low, high = sorted((root(a), root(b)))
        parent[high] = low
    ids, inverse = np.unique(tracks.track_ids, return_inverse=True)
    merged = np.array([root(i) if i in parent else i for i in ids.tolist()], dtype=np.int64)[inverse]
    _, first = np.unique(np.stack([tracks.frame_indices, merged], axis=1), axis=0, return_index=True)
    kept = np.sort(first)
    return replace(tracks.take(kept), track_ids=merged[kept])
