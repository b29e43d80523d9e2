"""Scenarios: what is simulated, as a validated document.

A scenario is a YAML file (or the name of a preset in `scenarios/`). Every key has a unit in its name and a
range; an unknown key, a wrong type or a value out of range is a `UsageError` that names the field.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rigwake.errors import InputError, UsageError
from rigwake.text_files import read_text_file
from rigwake.yaml_input import parse_yaml

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Point = tuple[float, float, float]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Rate = Annotated[float, Field(gt=0, le=1000)]


class Strict(BaseModel):
    """A part of a scenario: frozen, finite numbers, no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, protected_namespaces=())


class Scene(Strict):
    """The land around the water. `seed` (default: the scenario's) fixes it while other seeds vary.

    size_m: length and width of the water. density: how much there is to see, 1 = a busy harbour, 0 = bare
    shore without texture on it.
    """

    layout: Literal["harbour", "bay", "canal", "marina"] = "harbour"
    size_m: tuple[Annotated[float, Field(ge=30, le=2000)], Annotated[float, Field(ge=30, le=2000)]] = (
        150,
        110,
    )
    density: Annotated[float, Field(ge=0, le=2)] = 1.0
    seed: int | None = None


class Sea(Strict):
    """JONSWAP sea (gamma 1 is Pierson-Moskowitz). `direction_deg`: where waves travel to, from east to north."""

    hs_m: Annotated[float, Field(ge=0, le=5)] = 0.25
    tp_s: Annotated[float, Field(gt=0.5, le=20)] = 3.2
    gamma: Annotated[float, Field(ge=1, le=10)] = 3.3
    direction_deg: Degrees = 35.0
    spreading: Annotated[float, Field(ge=1, le=50)] = 6.0


class Weather(Strict):
    """Sun position (azimuth from east to north) and how much of the sky is cloud."""

    sun_azimuth_deg: Degrees = 235.0
    sun_elevation_deg: Annotated[float, Field(ge=3, le=90)] = 42.0
    cloud_cover: Fraction = 0.45


class Manoeuvre(Strict):
    """One leg. Of `duration_s` and `angle_deg` a turn takes one; `rate_deg_s` > 0 turns to port.

    straight: as it says. turn: constant rate. figure_eight: full circle one way, full circle the other.
    dock: slows from `speed_mps` to a stop while moving sideways at `sway_mps` (> 0 to port). standstill.
    """

    type: Literal["straight", "turn", "figure_eight", "dock", "standstill"]
    duration_s: Positive | None = None
    angle_deg: Positive | None = None
    rate_deg_s: Annotated[float, Field(ge=-60, le=60)] = 0.0
    speed_mps: Annotated[float, Field(ge=-15, le=30)] | None = None
    sway_mps: Annotated[float, Field(ge=-3, le=3)] = 0.0

    @model_validator(mode="after")
    def _duration_is_known(self) -> Manoeuvre:
        turning = self.type in ("turn", "figure_eight")
        if turning and self.rate_deg_s == 0:
            raise ValueError(f"a {self.type} needs rate_deg_s")
        if self.type == "turn" and (self.duration_s is None) == (self.angle_deg is None):
            raise ValueError("a turn needs exactly one of duration_s and angle_deg")
        if not turning and self.duration_s is None:
            raise ValueError(f"a {self.type} needs duration_s")
        return self


class InitialState(Strict):
    """Where the boat starts; heading from east to north."""

    east_m: float
    north_m: float
    heading_deg: Degrees


class Vessel(Strict):
    """The boat. The rig frame (`base_link`) is amidships on the still waterline: x bow, y port, z up.

    slip: sideways drift in a turn, metres per radian turned. `start` is chosen in the middle of the water if
    left out. `clearance_m`: free water kept around the hull. `response`: scales heave, roll and pitch.
    """

    hull: Literal["catamaran", "ferry", "workboat", "sailboat"] = "catamaran"
    manoeuvres: Annotated[tuple[Manoeuvre, ...], Field(min_length=1)]
    start: InitialState | None = None
    slip_m: Annotated[float, Field(ge=0, le=20)] = 0.3
    clearance_m: Annotated[float, Field(ge=0, le=100)] = 3.0
    response: Annotated[float, Field(ge=0, le=3)] = 1.0


class ImageNoise(Strict):
    """What a sensor does to a picture, on 8-bit values.

    read_std: of the dark. shot: variance per grey value. vignette: loss of light at the image circle's edge.
    gain, gain_drift: exposure against the others, and the amplitude of its slow wander.
    """

    read_std: Annotated[float, Field(ge=0, le=50)] = 0.7
    shot: Annotated[float, Field(ge=0, le=2)] = 0.02
    vignette: Annotated[float, Field(ge=0, le=0.95)] = 0.25
    gain: Annotated[float, Field(gt=0.1, le=5)] = 1.0
    gain_drift: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.5


class Camera(Strict):
    """A camera: lens, mounting and clock.

    model, params: a lens of `rigwake.cameras` by name. fov_deg: full angle of the image circle, black beyond.
    yaw (to port), pitch (down), roll turn the optical axis from straight ahead. `time_offset_ms`:
    `t_rig = t_cam + time_offset`. rolling_shutter_ms: from the first row to the last.
    """

    name: Name
    model: str
    width_px: Annotated[int, Field(ge=16, le=8192)]
    height_px: Annotated[int, Field(ge=16, le=8192)]
    params: dict[str, float] = Field(default_factory=dict)
    fov_deg: Annotated[float, Field(gt=1, le=360)]
    position_m: Point
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0
    rate_hz: Rate = 10.0
    time_offset_ms: Annotated[float, Field(ge=-2000, le=2000)] = 0.0
    rolling_shutter_ms: Annotated[float, Field(ge=0, le=200)] = 0.0
    noise: ImageNoise = ImageNoise()


class Imu(Strict):
    """Inertial unit. Noise: continuous-time densities and bias random walks; bias at the start: its std."""

    rate_hz: Rate = 100.0
    position_m: Point = (0.0, 0.0, 1.0)
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0
    gyro_noise_density: NonNegative = 1.5e-4
    accel_noise_density: NonNegative = 2.0e-3
    gyro_bias_walk: NonNegative = 2.0e-5
    accel_bias_walk: NonNegative = 3.0e-4
    gyro_bias_std: NonNegative = 3e-3
    accel_bias_std: NonNegative = 4e-2


class Gnss(Strict):
    """Satellite positioning. `quality` sets the noise (rtk: 2 cm; standalone: 1.2 m, mostly correlated over
    two minutes); white_std_m, correlated_std_m, correlated_tau_s override it. Vertical errors are 1.6 times as large.
    outages_s: (from, to) without fixes."""

    rate_hz: Rate = 5.0
    position_m: Point = (0.0, 0.0, 1.5)
    quality: Literal["rtk", "standalone", "perfect"] = "rtk"
    white_std_m: NonNegative | None = None
    correlated_std_m: NonNegative | None = None
    correlated_tau_s: Positive = 120.0
    outages_s: tuple[tuple[NonNegative, NonNegative], ...] = ()
    with_velocity: bool = False
    origin_lla: tuple[
        Annotated[float, Field(ge=-89, le=89)], Annotated[float, Field(ge=-180, le=180)], float
    ] = (57.69, 11.9, 38.5)


class Attitude(Strict):
    """A compass (`heading`: roll and pitch unknown) or an attitude reference (`ahrs`)."""

    kind: Literal["heading", "ahrs"] = "ahrs"
    rate_hz: Rate = 20.0
    std_deg: NonNegative = 0.3
    correlated_tau_s: Positive = 60.0


class Output(Strict):
    """How pictures are made: rays per pixel (a square number), and how they are stored."""

    samples_per_pixel: Literal[1, 4, 9, 16] = 4
    jpeg_quality: Annotated[int, Field(ge=30, le=100)] = 90
    colour: bool = True


class Tracking(Strict):
    """Tracks-only mode: what an imperfect tracker would deliver.

    features: per camera and frame, about. lifetime_s: mean of a track. noise_px: per coordinate.
    outliers: fraction of observations that are wrong by up to `outlier_px`. water: tracks on moving water per
    track on land. landmarks: points on land to choose from.
    """

    features: Annotated[int, Field(ge=1, le=5000)] = 150
    lifetime_s: Positive = 4.0
    noise_px: Annotated[float, Field(ge=0, le=20)] = 0.2
    outliers: Fraction = 0.01
    outlier_px: Positive = 30.0
    water: Annotated[float, Field(ge=0, le=5)] = 0.2
    landmarks: Annotated[int, Field(ge=10, le=200_000)] = 2000


class Scenario(Strict):
    """A whole scenario. `start_s`: stamp of the first instant. `seed` fixes everything that is random."""

    name: Name
    about: str = ""
    seed: Annotated[int, Field(ge=0)] = 0
    duration_s: Annotated[float, Field(ge=0.5, le=7200)]
    start_s: NonNegative = 20.0
    scene: Scene = Scene()
    sea: Sea = Sea()
    weather: Weather = Weather()
    vessel: Vessel
    cameras: Annotated[tuple[Camera, ...], Field(min_length=1, max_length=32)]
    imu: Imu | None = None
    gnss: Gnss | None = None
    attitude: Attitude | None = None
    output: Output = Output()
    tracking: Tracking = Tracking()

    @model_validator(mode="after")
    def _names_are_unique(self) -> Scenario:
        names = [camera.name for camera in self.cameras]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"cameras: the name {twice[0]!r} appears twice")
        return self

    @property
    def scene_seed(self) -> int:
        """The seed of everything that stands still."""
        return self.seed if self.scene.seed is None else self.scene.seed


def preset_names() -> tuple[str, ...]:
    """Names of the scenarios that come with rigwake."""
    folder = resources.files("rigwake.simulation") / "scenarios"
    return tuple(sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml")))


def load_scenario(source: str | Path) -> Scenario:
    """A preset by name, or a scenario file. UsageError names what is wrong, and where."""
    text = str(source)
    if text in preset_names():
        return parse_scenario(_preset_text(text), text)
    path = Path(source)
    if not path.is_file():
        raise UsageError(
            f"No scenario {text!r}: neither a file nor a preset.",
            remedy=f"Presets: {', '.join(preset_names())}.",
        )
    return parse_scenario(read_text_file(path), path.name)


def parse_scenario(text: str, origin: str = "scenario") -> Scenario:
    """A scenario from YAML text; `origin` names it in errors (UsageError).

    `base: PRESET` starts from a preset; what the text says replaces it, part by part.
    """
    return build_scenario(_document(text, origin), origin)


def _preset_text(name: str) -> str:
    return (resources.files("rigwake.simulation") / "scenarios" / f"{name}.yaml").read_text(encoding="utf-8")


def _document(text: str, origin: str) -> Any:
    try:
        document = parse_yaml(text, origin)
    except InputError as error:
        raise UsageError(f"{origin} is not YAML: {error.cause}") from error
    if not isinstance(document, dict) or "base" not in document:
        return document
    base = document.pop("base")
    if base not in preset_names():
        raise UsageError(
            f"{origin}: base: no preset {base!r}.", remedy=f"Presets: {', '.join(preset_names())}."
        )
    return _merged(_document(_preset_text(base), base), document)


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """`above` over `below`, mapping by mapping; lists are replaced."""
    merged = dict(below)
    for key, value in above.items():
        inside = isinstance(value, dict) and isinstance(below.get(key), dict)
        merged[key] = _merged(below[key], value) if inside else value
    return merged


def changed_scenario(scenario: Scenario, duration_s: float | None, seed: int | None) -> Scenario:
    """The scenario with another duration or random seed, where they are given."""
    changes = {"duration_s": duration_s, "seed": seed}
    given = {key: value for key, value in changes.items() if value is not None}
    return build_scenario(scenario.model_dump() | given, scenario.name) if given else scenario


def build_scenario(document: Any, origin: str = "scenario") -> Scenario:
    """A scenario from a plain mapping; UsageError lists every field that is wrong."""
    try:
        return Scenario.model_validate(document)
    except ValidationError as error:
        wrong = [f"{_field(item['loc'])}: {_message(dict(item))}" for item in error.errors()]
        raise UsageError(
            f"{origin}: " + "; ".join(wrong[:8]),
            consequence="Nothing was simulated.",
            remedy="The schema is in docs/simulator.md; `rigwake simulate --show PRESET` prints one that works.",
        ) from error


def _field(location: tuple[int | str, ...]) -> str:
    name = ""
    for part in location:
        name += f"[{part}]" if isinstance(part, int) else f".{part}" if name else part
    return name or "scenario"


def _message(item: dict[str, Any]) -> str:
    if item["type"] == "extra_forbidden":
        return "unknown key"
    if item["type"] == "missing":
        return "is missing"
    message = str(item["msg"]).removeprefix("Value error, ")
    given = item.get("input")
    return f"{message} (got {given!r})" if isinstance(given, int | float | str) else message
