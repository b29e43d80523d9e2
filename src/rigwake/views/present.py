"""Finished pictures of a view: drawn, levelled, coloured, with rings, bumper and words; for stills, video and live."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rigwake._types import Image
from rigwake.calibration import Calibration
from rigwake.errors import InputError
from rigwake.extras import require_extra
from rigwake.views.attitude import LevelAttitude
from rigwake.views.blend import blended_still
from rigwake.views.colour import GainSmoother
from rigwake.views.draw import caption, draw_top_view, hatch_missing, water_uncertainty
from rigwake.views.frames import FrameSet, frame_sets
from rigwake.views.prepare import SurroundSetup, require_pictures
from rigwake.views.projections import Bowl, CylinderView, EquirectangularView, TopDown, ViewProjection
from rigwake.views.surface import Surface
from rigwake.views.surround_view import SurroundView


@dataclass(frozen=True)
class Decoration:
    """What is drawn over a top view. size_m: length and width of the vessel; None: around the cameras."""

    bumper_m: float = 5.0
    size_m: tuple[float, float] | None = None
    fill_vessel: bool = False
    wave_std_m: float = 0.0
    calibration: Calibration | None = None


@dataclass
class Presenter:
    """Draws finished pictures of one view."""

    view: SurroundView
    decoration: Decoration
    smoother: GainSmoother | None = field(default=None)

    @classmethod
    def of(cls, setup: SurroundSetup, projection: ViewProjection, decoration: Decoration) -> Presenter:
        """For a setup's rig, masks and colours."""
        view = SurroundView(setup.rig, projection, setup.masks, setup.colour)
        return cls(view, decoration, GainSmoother(setup.colour) if setup.colour is not None else None)

    def follow_gains(self, frames: FrameSet, attitude: LevelAttitude) -> None:
        """Let the gains follow the exposure, smoothed over time."""
        if self.smoother is not None and (~frames.is_missing).sum() > 1:
            self.view.colour = self.smoother.update(
                frames.images(self.view.rig), self.view.rig, attitude, frames.timestamp_ns
            )

    def picture(
        self, frames: FrameSet, attitude: LevelAttitude, surface: Surface, careful: bool = False
    ) -> Image:
        """(H, W, 3) BGR. careful: graph-cut seams and multi-band blending, for stills."""
        projection = self.view.projection
        wraps = isinstance(projection, EquirectangularView | CylinderView)
        if careful:
            picture = blended_still(self.view, frames, attitude, surface, wraps)
        else:
            picture = self.view.picture(frames, attitude, surface)
        if frames.missing:
            sectors = self.view.missing_sectors(frames, attitude, surface)
            hatch_missing(picture, sectors, frames.names, frames.missing)
        if isinstance(projection, TopDown):
            d = self.decoration
            uncertainty = water_uncertainty(attitude, d.calibration, d.wave_std_m)
            draw_top_view(
                picture,
                projection,
                self.view.rig,
                attitude,
                uncertainty,
                surface,
                d.bumper_m,
                d.size_m,
                d.fill_vessel,
            )
        if attitude.source == "none":
            caption(picture, "not levelled: no attitude is known and no horizon was found")
        return picture


def is_sphere(projection: ViewProjection) -> bool:
    """Whether a player should show the view as a sphere: the full equirectangular panorama."""
    return isinstance(projection, EquirectangularView) and projection.width_px == 2 * projection.height_px


def needs_height(projection: ViewProjection) -> bool:
    """Whether the view is drawn on the water."""
    return isinstance(projection, TopDown | Bowl)


def write_video(
    setup: SurroundSetup, presenter: Presenter, path: Path, start_s: float | None = None
) -> Iterator[tuple[int, int]]:
    """Write a video of all frame sets from a time on; yields pictures done and all of them.

    Frame sets of which every camera is missing are left out. Raises InputError if that is so for all.
    """
    require_extra("av", "video", "Writing a video")
    from rigwake.views.video import video_file

    times = setup.times_ns()
    if start_s is not None:
        times = times[(times - times[0]) * 1e-9 >= start_s - 1e-6]
    if not len(times):
        raise InputError("The recording has no pictures from that time on.")
    rate_hz = 1e9 / float(np.median(np.diff(times))) if len(times) > 1 else 10.0
    projection = presenter.view.projection
    written = 0
    last: FrameSet | None = None
    with video_file(path, projection.width_px, projection.height_px, rate_hz, is_sphere(projection)) as video:
        for done, frames in enumerate(frame_sets(setup.streams, setup.rig, times)):
            last = frames
            if not frames.is_missing.all():
                attitude = setup.attitude_at(frames)
                presenter.follow_gains(frames, attitude)
                surface = setup.surface_at(frames, attitude)
                video.write(presenter.picture(frames, attitude, surface), frames.timestamp_ns)
                written += 1
            yield done + 1, len(times)
        if not written and last is not None:
            require_pictures(last)
