"""Live sources: network cameras, devices and video files through PyAV, paired by time stamp."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rigwake._types import Image
from rigwake.cameras.protocol import CameraModel
from rigwake.errors import InputError, UsageError
from rigwake.views.attitude import LevelAttitude
from rigwake.views.colour import GainSmoother, colour_samples, fit_colour
from rigwake.views.frames import FrameSet, FrameWatch, place, require_size
from rigwake.views.levelling import Leveller
from rigwake.views.prepare import SurroundOptions, choose_surface
from rigwake.views.present import Decoration
from rigwake.views.rig_sources import read_rig_source
from rigwake.views.serve.feed import Newest
from rigwake.views.serve.screens import Screens
from rigwake.views.serve.server import LiveServer, run_server
from rigwake.views.surface import SHELL_M, SurfaceSource
from rigwake.views.surround_rig import SurroundRig, surround_rig

_KEPT = 12  # pictures of one camera that wait for the others
_STALE_S = 1.5  # a camera silent for longer is missing
_FIRST_S = 15.0  # to wait for a first picture
_RETRY_S = 2.0
_OPTIONS = {"rtsp_transport": "tcp", "timeout": "5000000", "stimeout": "5000000"}


def parse_sources(specs: Sequence[str], rig: SurroundRig) -> dict[str, str]:
    """`CAMERA=URL` by camera. UsageError for unknown cameras and malformed sources."""
    sources: dict[str, str] = {}
    for spec in specs:
        name, separator, url = spec.partition("=")
        if not separator or not url:
            raise UsageError(
                f"--from {spec!r} is not CAMERA=URL.",
                remedy="Write --from front=rtsp://HOST/PATH, /dev/video0 or FILE.",
            )
        if name not in rig.names:
            raise UsageError(
                f"--from {spec!r}: the calibration has no camera {name!r}.",
                remedy=f"It has: {', '.join(rig.names)}.",
            )
        sources[name] = url
    return sources


class LiveCamera(threading.Thread):
    """Decodes one source; keeps its last pictures with their times (time of day, nanoseconds).

    Files are played in real time, over and over; other sources are opened again when they break.
    """

    def __init__(self, name: str, url: str, width_px: int, height_px: int, start_ns: int) -> None:
        super().__init__(daemon=True, name=f"live {name}")
        self.camera, self._url, self._size = name, url, (width_px, height_px)
        self._start_ns = start_ns
        self._pictures: deque[tuple[int, Image]] = deque(maxlen=_KEPT)
        self._stopped = threading.Event()
        self.fault = "no picture yet"

    def stop(self) -> None:
        """End the thread soon."""
        self._stopped.set()

    def pictures(self) -> list[tuple[int, Image]]:
        """The last pictures, oldest first."""
        return list(self._pictures)

    def run(self) -> None:
        """Decode until stopped."""
        import av  # an extra: pairing pictures of other sources goes without it

        while not self._stopped.is_set():
            try:
                self._play()
                self.fault = "the source ended"
            except (av.FFmpegError, OSError, InputError) as error:
                self.fault = str(error)
            if not self._is_file():
                self._stopped.wait(_RETRY_S)

    def _is_file(self) -> bool:
        return Path(self._url).is_file()

    def _play(self) -> None:
        import av

        is_file, is_device = self._is_file(), self._url.startswith("/dev/")
        form = "v4l2" if is_device else None
        options = {} if is_file or is_device else _OPTIONS
        with av.open(
            self._url, format=form, options=options, timeout=None if is_file else (8.0, 5.0)
        ) as container:
            if not container.streams.video:
                raise InputError("there is no video in it")
            start_ns, first = self._start_ns, None
            last_ns = start_ns
            for frame in container.decode(container.streams.video[0]):
                if self._stopped.is_set():
                    return
                stamp = time.time_ns()
                if is_file:
                    seconds = float(frame.time or 0.0)
                    first = seconds if first is None else first
                    stamp = start_ns + round((seconds - first) * 1e9)
                    self._stopped.wait(max((stamp - time.time_ns()) * 1e-9, 0.0))
                last_ns = stamp
                image = frame.to_ndarray(format="bgr24")
                if (image.shape[1], image.shape[0]) != self._size:
                    raise InputError(
                        f"pictures are {image.shape[1]} x {image.shape[0]}, the lens {self._size[0]} x {self._size[1]}"
                    )
                self.fault = ""
                self._pictures.append((stamp, image))
            if is_file:  # again from the start, one period later
                self._start_ns = max(last_ns, start_ns) + 100_000_000


def paired(
    rig: SurroundRig,
    pictures: Mapping[str, Sequence[tuple[int, Image | Callable[[], Image]]]],
    faults: Mapping[str, str],
    now_ns: int,
    watches: Mapping[str, FrameWatch],
) -> FrameSet | None:
    """The newest frame set: at the newest time that every camera which is not silent has reached.

    pictures: (time, picture, or what decodes it) by camera, oldest first; only what is shown is decoded, and what
    raises InputError is missing. A camera silent for more than 1.5 s is missing. None if no
    camera has a picture.
    """
    offsets = dict(zip(rig.names, rig.time_offsets_s, strict=True))
    shifted = {n: [(t + round(offsets[n] * 1e9), p) for t, p in pictures.get(n, ())] for n in rig.names}
    awake = {n: s for n, s in shifted.items() if s and now_ns - s[-1][0] < _STALE_S * 1e9}
    if not awake:
        return None
    target = min(s[-1][0] for s in awake.values())
    shape = (len(rig), max(m.height_px for m in rig.models), max(m.width_px for m in rig.models), 3)
    stack = np.zeros(shape, dtype=np.uint8)
    missing: dict[str, str] = {}
    late = np.full(len(rig), np.nan)
    for index, name in enumerate(rig.names):
        if name not in awake:
            missing[name] = faults.get(name) or "silent"
            continue
        times = np.array([t for t, _ in awake[name]], dtype=np.int64)
        nearest = int(np.abs(times - target).argmin())
        period = float(np.median(np.diff(times))) * 1e-9 if len(times) > 1 else np.inf
        late[index] = float(times[nearest] - target) * 1e-9
        if abs(late[index]) > max(0.5 * period, 0.005) + 0.02:
            missing[name] = f"late by {abs(late[index]):.2f} s"
            continue
        try:
            picture = _decoded(name, awake[name][nearest][1], rig.models[index])
        except InputError as error:
            missing[name] = error.cause
            continue
        if fault := watches[name].fault(picture, int(times[nearest])):
            missing[name] = fault
        else:
            place(stack[index], picture)
    return FrameSet(target, rig.names, stack, missing, late)


def _decoded(name: str, picture: Image | Callable[[], Image], model: CameraModel) -> Image:
    if not callable(picture):
        return picture
    image = picture()
    require_size(name, image, model.width_px, model.height_px)
    return image


class LiveFeed(threading.Thread):
    """Puts the newest frame set of live cameras into `newest`, levelled by the horizon, colours followed."""

    def __init__(
        self,
        rig: SurroundRig,
        cameras: Mapping[str, LiveCamera],
        leveller: Leveller,
        surfaces: SurfaceSource,
        newest: Newest,
        screens: Screens,
    ) -> None:
        super().__init__(daemon=True, name="live feed")
        self._rig, self._cameras, self._leveller = rig, cameras, leveller
        self._surfaces, self._newest, self._screens = surfaces, newest, screens
        self._stopped = threading.Event()
        self._watches = {name: FrameWatch() for name in rig.names}
        self._smoother: GainSmoother | None = None

    def stop(self) -> None:
        """End the threads soon."""
        self._stopped.set()
        for camera in self._cameras.values():
            camera.stop()

    def run(self) -> None:
        """Pair until stopped."""
        last_ns = 0
        while not self._stopped.is_set():
            faults = {n: c.fault for n, c in self._cameras.items()}
            faults |= {n: "no source given" for n in self._rig.names if n not in self._cameras}
            pictures = {n: c.pictures() for n, c in self._cameras.items()}
            frames = paired(self._rig, pictures, faults, time.time_ns(), self._watches)
            if frames is None or frames.timestamp_ns <= last_ns:
                if frames is None:
                    self._newest.error = "; ".join(f"{n}: {why}" for n, why in faults.items() if why)
                self._stopped.wait(0.005)
                continue
            last_ns = frames.timestamp_ns
            images = frames.images(self._rig)
            attitude = self._leveller.at(frames.timestamp_ns, images)
            self._follow(frames, attitude)
            surface = self._surfaces.surface(images, self._rig, attitude, frames.timestamp_ns)
            self._newest.put(frames, attitude, surface, frames.timestamp_ns * 1e-9)

    def _follow(self, frames: FrameSet, attitude: LevelAttitude) -> None:
        images = frames.images(self._rig)
        if len(images) < 2:
            return
        if self._smoother is None:
            samples = colour_samples(images, self._rig, attitude)
            if len(samples) < 100:
                return
            self._smoother = GainSmoother(fit_colour(samples, len(self._rig)))
        colour = self._smoother.update(images, self._rig, attitude, frames.timestamp_ns)
        self._screens.set_colour(colour)


def live_feed(
    calibration: Path, specs: Sequence[str], options: SurroundOptions, decoration: Decoration
) -> tuple[LiveFeed, Newest, Screens]:
    """Open all sources and wait for a first picture. Raises InputError if none comes, UsageError for wrong sources."""
    source = read_rig_source(calibration)
    rig = surround_rig(source.rig)
    sources = parse_sources(specs, rig)
    known = options.height_m is not None
    surfaces = choose_surface(options.surface, options.shell_m or SHELL_M, known)
    leveller = Leveller(
        rig, "levelled by the horizon in the pictures", use_horizon=options.stabilise != "off"
    )
    if options.height_m is not None:
        leveller = leveller.with_height(options.height_m, 0.02 * options.height_m)
    start_ns = time.time_ns()
    cameras = {}
    for name, url in sources.items():
        model = rig.models[rig.names.index(name)]
        cameras[name] = LiveCamera(name, url, model.width_px, model.height_px, start_ns)
        cameras[name].start()
    waited = time.monotonic() + _FIRST_S
    while not any(c.pictures() for c in cameras.values()):
        if time.monotonic() > waited or all(c.fault not in ("", "no picture yet") for c in cameras.values()):
            faults = "; ".join(f"{n}: {c.fault}" for n, c in cameras.items())
            for camera in cameras.values():
                camera.stop()
            raise InputError(f"No picture comes from any source ({faults}).", remedy="Check the addresses.")
        time.sleep(0.02)
    newest = Newest()
    screens = Screens(rig, None, None, decoration, known)
    return LiveFeed(rig, cameras, leveller, surfaces, newest, screens), newest, screens


def serve_live(
    calibration: Path,
    specs: Sequence[str],
    options: SurroundOptions,
    host: str,
    port: int,
    decoration: Decoration,
    say: Callable[[str], None] = print,
) -> None:
    """Show live sources in the browser until interrupted."""
    feed, newest, screens = live_feed(calibration, specs, options, decoration)
    feed.start()
    try:
        run_server(LiveServer(newest, screens, host, port), say)
    finally:
        feed.stop()
