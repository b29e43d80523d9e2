"""Rounds of cross-camera association: predict, look, add, adjust again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigwake._robust import MAD_TO_STD
from rigwake._tables import join_rows
from rigwake._types import Mask
from rigwake.ba.rig.association import find_landmarks
from rigwake.ba.rig.height_prior import restore_priors, with_height_prior
from rigwake.ba.rig.outlier_rounds import adjust
from rigwake.ba.rig.rig_values import AdjustedRig, AdjustmentOptions, AssembledProblem
from rigwake.ba.rig.search_proposals import AssociationOptions, predicted_pixels, propose_searches
from rigwake.ba.solver.rig_problem import Observations, RigProblem, RigSolution
from rigwake.recording import CameraStream
from rigwake.tracking.masks import beyond_lens, mask_from_file

_FEWEST_TO_WEIGH = 20
_HELD_OUT = 7  # one landmark in seven is only used to check the result


@dataclass(frozen=True, eq=False)
class CrossCameraMatches:
    """What was associated across cameras. used: number of observations added. unused: those held out."""

    used: int
    unused: Observations

    @classmethod
    def nothing(cls) -> CrossCameraMatches:
        """Nothing was associated across cameras."""
        return cls(0, Observations.empty())


def joined(first: Observations, second: Observations) -> Observations:
    """These observations, then those."""
    return join_rows([first, second])


def adjust_with_association(
    adjusted: AdjustedRig,
    streams: Mapping[str, CameraStream],
    masks_folder: Path,
    options: AdjustmentOptions,
    search: AssociationOptions,
    progress: Callable[[str], None],
) -> tuple[AdjustedRig, CrossCameraMatches]:
    """The rig adjusted with landmarks found again in other cameras and at other times.

    Every round predicts with what the one before has found. What is found of the held-out landmarks in other images
    is never used by any round; those of the last are returned, to check the result. Heights that nothing has told
    yet are held until then.
    """
    used, unused = 0, Observations.empty()
    free = adjusted.solution.problem
    usable = _usable(masks_folder, free)
    level = with_height_prior(free)
    if level is not free:
        progress("adjusting with cameras held near one height")
        held = AssembledProblem(level, adjusted.track_cameras, adjusted.track_ids)
        adjusted = adjust(held, replace(options, rounds=1), final=False)
    for done in range(search.rounds):
        last = done == search.rounds - 1
        problem = adjusted.solution.problem
        images = _images(problem.observations, [c.name for c in problem.cameras])
        progress(f"looking for landmarks in other cameras, round {done + 1}")
        searches = propose_searches(problem, images, usable, search)
        found = find_landmarks([camera.name for camera in problem.cameras], searches, streams, search)
        is_held_out = held_out_landmarks(adjusted)[found.landmark_indices]
        found, held_out = found.take(~is_held_out), found.take(is_held_out)
        found = _weighed(found, adjusted.solution)
        progress(f"adjusting with {len(found)} observations associated across cameras")
        with_found = AssembledProblem(
            replace(
                restore_priors(problem, free) if last else problem,
                observations=joined(problem.observations, found),
            ),
            adjusted.track_cameras,
            adjusted.track_ids,
        )
        before = adjusted
        adjusted = adjust(with_found, replace(options, rounds=2 if last else 1), final=last)
        used += len(found)
        unused = _renumbered(held_out, before, adjusted)
    return adjusted, CrossCameraMatches(used, unused)


def held_out_landmarks(adjusted: AdjustedRig) -> Mask:
    """(L,) which landmarks are held out: the same tracks in every round, whatever their numbers have become."""
    spread = (
        adjusted.track_ids * 2_654_435_761 + adjusted.track_cameras * 40_503
    ) % 2**32  # Knuth's multiplicative hash
    return np.asarray((spread >> 16) % _HELD_OUT == 0)


def _weighed(found: Observations, solution: RigSolution) -> Observations:
    """With the spread that they show about their predictions, where it is larger than assumed.

    A patch seen from elsewhere differs from its source by more than noise: its depth, its edges. Only the images
    can tell by how much.
    """
    predicted = predicted_pixels(solution.problem, found)
    whitened = np.abs(predicted - found.pixels) / found.std_px[:, None]
    known = np.isfinite(whitened).all(axis=1)
    if known.sum() < _FEWEST_TO_WEIGH:
        return found
    spread = MAD_TO_STD * float(np.median(whitened[known]))
    return replace(found, std_px=found.std_px * max(spread, 1.0))


def _images(observations: Observations, names: list[str]) -> dict[str, NDArray[np.int64]]:
    """Per camera, the stamps of the images that take part."""
    return {
        name: np.unique(observations.timestamps_ns[observations.camera_indices == index])
        for index, name in enumerate(names)
    }


def _usable(folder: Path, problem: RigProblem) -> dict[str, Mask]:
    """Per camera, the pixels (H, W) that show something: within the lens, and in the mask that the camera stage
    left."""
    usable = {}
    for camera in problem.cameras:
        model, file = camera.model, folder / f"{camera.name}.png"
        usable[camera.name] = ~beyond_lens(model)
        if file.is_file():
            usable[camera.name] &= mask_from_file(file, model.width_px, model.height_px).usable
    return usable


def _renumbered(observations: Observations, before: AdjustedRig, after: AdjustedRig) -> Observations:
    """The same observations with the landmark numbers of a later round; those whose landmark went are left out."""
    key_after = {
        (int(camera), int(track)): row
        for row, (camera, track) in enumerate(zip(after.track_cameras, after.track_ids, strict=True))
    }
    rows = [
        key_after.get((int(before.track_cameras[k]), int(before.track_ids[k])), -1)
        for k in observations.landmark_indices
    ]
    landmark_indices = np.array(rows, dtype=np.int64)
    kept = landmark_indices >= 0
    return replace(observations, landmark_indices=landmark_indices).take(kept)
