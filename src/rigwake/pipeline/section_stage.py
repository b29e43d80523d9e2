"""Which sections of a recording take part: chosen before anything is tracked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake._progress import CountProgress
from rigwake.config import CalibrateConfig
from rigwake.errors import RigwakeError, UnobservableError
from rigwake.pipeline.stream_selection import Selection, select
from rigwake.recording import Recording
from rigwake.sections.section_plan import (
    USE_ALL_BELOW_S,
    SectionPlan,
    SectionWish,
    cut_to_sections,
    plan_sections,
)
from rigwake.sections.section_words import choice_words, parse_precision

_UNTOLD = "sections were not chosen: without an IMU and GNSS nothing tells beforehand how the vessel moves"


def section_wish(config: CalibrateConfig) -> SectionWish:
    """What the settings ask for."""
    precision = None if config.precision is None else parse_precision(config.precision)
    return SectionWish(config.use_all, precision, config.budget_s)


def with_chosen_sections(
    selection: Selection, config: CalibrateConfig, progress: CountProgress
) -> tuple[Selection, SectionPlan | None]:
    """The selection cut to the sections worth using, and the plan; unchanged, and None, where all is used anyway.

    Raises UnobservableError where the motion tells nothing, or a camera has no frames in what is chosen.
    """
    wish = section_wish(config)
    if wish.everything or (wish.is_default and _seconds(selection) <= USE_ALL_BELOW_S):
        return selection, None
    plan = _plan(selection, config, progress)
    if isinstance(plan, str):
        return replace(selection, notes=(*selection.notes, plan)), None
    cameras, gnss = cut_to_sections(plan, selection.cameras, selection.gnss)
    if not cameras:
        raise UnobservableError(
            "No camera has frames in the sections that tell of the rig.",
            remedy="Use --all, or look at `rigwake inspect` for cameras that stop early.",
        )
    left_out = {
        name: "it has no frames in the sections used" for name in selection.cameras if name not in cameras
    }
    chosen = replace(
        selection,
        cameras=cameras,
        gnss=gnss,
        notes=(*selection.notes, choice_words(plan)),
        left_out={**selection.left_out, **left_out},
    )
    return chosen, plan


def planned_sections(
    recording: Recording, config: CalibrateConfig, progress: CountProgress = lambda words, done, total: None
) -> SectionPlan | str:
    """What `calibrate` would use of a recording with these settings, and what that predicts; or why nobody can tell."""
    try:
        return _plan(select(recording, config), config, progress)
    except RigwakeError as error:
        return error.cause


def _plan(selection: Selection, config: CalibrateConfig, progress: CountProgress) -> SectionPlan | str:
    """The plan, or why there is none; then all is used."""
    try:
        plan = plan_sections(
            selection.cameras,
            selection.imu,
            selection.gnss,
            section_wish(config),
            config.adjustment,
            progress,
        )
    except (ArithmeticError, IndexError, ValueError, np.linalg.LinAlgError) as error:
        # a forecast that fails must not stop a calibration that may not
        return f"sections were not chosen: a fault of the program, please report it ({type(error).__name__}: {error})"
    return _UNTOLD if plan is None else plan


def _seconds(selection: Selection) -> float:
    stamps = [camera.timestamps_ns for camera in selection.cameras.values() if len(camera)]
    return float(max(s[-1] for s in stamps) - min(s[0] for s in stamps)) * 1e-9 if stamps else 0.0
