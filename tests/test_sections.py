"""Sections of a long recording are chosen by what they tell: turns, not straight legs; only as much as is asked for."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from calibration_worlds import first_values, measurements, sail
from rigwake.ba.rig.assemble_problem import assemble_problem
from rigwake.ba.solver.imu_factors import inertial_factors
from rigwake.ba.solver.linear_factors import inside_states
from rigwake.ba.solver.parameter_layout import layout_of
from rigwake.config import load_config
from rigwake.errors import UnobservableError, UsageError
from rigwake.excerpt import camera_between
from rigwake.pipeline.section_stage import planned_sections, with_chosen_sections
from rigwake.pipeline.stream_selection import select
from rigwake.recording import CameraStream, Frame
from rigwake.sections.section_choice import Precision, choose_sections, tells_no_place
from rigwake.sections.section_plan import SectionPlan, texture_over_time
from rigwake.sections.section_words import (
    choice_words,
    duration_words,
    information_line,
    information_over_time,
    parse_precision,
    plan_to_dict,
    told_over_time,
)
from rigwake.sections.stretch_information import StretchInformation, stretch_spans

# the thesis's case: a straight first leg, then turns
LEG_S = 100.0
LEGS = [
    {"type": "straight", "duration_s": LEG_S, "speed_mps": 1.5},
    {"type": "turn", "rate_deg_s": 18, "angle_deg": 360, "speed_mps": 1.5},
    {"type": "turn", "rate_deg_s": -18, "angle_deg": 360},
    {"type": "straight", "duration_s": 10},
]
OFFLINE = ("adjustment.cross_camera=false",)


@lru_cache(maxsize=1)
def thesis_case():
    """150 s on calm water along a canal, without pictures."""
    return sail(
        ("front", "left"),
        features=20,
        duration_s=150,
        scene={"layout": "canal", "size_m": [400, 70]},
        sea={"hs_m": 0.0},
        vessel={"manoeuvres": LEGS},
    ).recording


def made_up(told: np.ndarray) -> StretchInformation:
    """Stretches that tell a camera's six axes as `told` (S, 6) says."""
    spans = stretch_spans(0, len(told) * 8 * 10**9, 8.0)
    parameters = {("front", "rig_from_cam"): slice(0, 6)}
    return StretchInformation(spans, parameters, np.array([np.diag(row) for row in told]), np.zeros((6, 6)))


def test_turns_are_chosen_and_the_straight_leg_is_not() -> None:
    plan = planned_sections(thesis_case(), load_config(None, OFFLINE, precision="30mm,1deg"))
    assert isinstance(plan, SectionPlan)
    start = plan.information.spans_ns[0, 0]
    begins = [(begin - start) * 1e-9 for begin, _ in plan.choice.sections_ns]
    assert min(begins) > LEG_S - 12
    assert plan.choice.seconds < 60
    assert not plan.is_all
    told = information_over_time(plan)
    assert told[: int(LEG_S // 8)].max() < 0.5 * told[int(LEG_S // 8) + 1 :].max()


def test_by_default_most_of_the_straight_leg_is_left_out() -> None:
    config = load_config(None, OFFLINE)
    selection = select(thesis_case(), config)
    chosen, plan = with_chosen_sections(selection, config, lambda *_: None)
    assert plan is not None
    assert plan.choice.seconds < 90
    whole, used = plan.choice.whole["front"], plan.choice.predicted["front"]
    assert used.translation <= 1.06 * whole.translation
    # frames and fixes of the sections alone, inertial samples of all
    inside = np.zeros(len(selection.cameras["left"]), dtype=bool)
    stamps = selection.cameras["left"].timestamps_ns
    for begin, end in plan.choice.sections_ns:
        inside |= (stamps >= begin) & (stamps < end)
    assert np.array_equal(chosen.cameras["left"].timestamps_ns, stamps[inside])
    assert len(chosen.gnss.timestamps_ns) < len(selection.gnss.timestamps_ns)
    assert len(chosen.imu.timestamps_ns) == len(selection.imu.timestamps_ns)
    assert "are used" in chosen.notes[-1]


def test_straight_leg_alone_is_refused() -> None:
    config = load_config(None, OFFLINE, duration_s=LEG_S - 8.0, precision="30mm,1deg")
    with pytest.raises(UnobservableError, match="hardly turns"):
        with_chosen_sections(select(thesis_case(), config), config, lambda *_: None)
    assert "hardly turns" in planned_sections(thesis_case(), config)


def test_short_recordings_and_all_are_used_whole() -> None:
    for config in (load_config(None, OFFLINE, duration_s=50), load_config(None, OFFLINE, use_all=True)):
        selection = select(thesis_case(), config)
        chosen, plan = with_chosen_sections(selection, config, lambda *_: None)
        assert chosen is selection
        assert plan is None


def test_without_gnss_sections_touch_and_without_sensors_all_is_used() -> None:
    config = load_config(None, OFFLINE, precision="0.5deg", gnss=False)
    _, plan = with_chosen_sections(select(thesis_case(), config), config, lambda *_: None)
    assert plan is not None
    assert len(plan.choice.sections_ns) == 1
    config = load_config(None, OFFLINE, gnss=False, imu=False)
    selection = select(thesis_case(), config)
    chosen, plan = with_chosen_sections(selection, config, lambda *_: None)
    assert plan is None
    assert chosen.cameras == selection.cameras
    assert "nothing tells beforehand" in chosen.notes[-1]


def test_budget_bounds_the_cost() -> None:
    plan = planned_sections(thesis_case(), load_config(None, OFFLINE))
    assert isinstance(plan, SectionPlan)
    tight = 0.5 * plan.cost.sections_s
    count = len(plan.information.spans_ns)
    chosen = choose_sections(
        plan.information, np.full(count, plan.whole_cost.sections_s / count), budget=tight
    )
    assert len(chosen.stretches) * plan.whole_cost.sections_s / count <= max(
        tight, plan.whole_cost.sections_s / 5
    )
    assert "CPU time" in chosen.reason


def test_only_the_stretches_that_differ_are_needed() -> None:
    rng = np.random.default_rng(0)
    told = 1e-3 * rng.uniform(1, 2, (40, 6)) * 1e5
    told[[12, 13, 14, 30]] *= 1e4
    choice = choose_sections(made_up(told), np.ones(40))
    assert choice.stretches.tolist() == [12, 13, 14, 30]
    assert choice.sections_ns == ((12 * 8 * 10**9, 15 * 8 * 10**9), (30 * 8 * 10**9, 31 * 8 * 10**9))
    assert choice.predicted["front"].translation < 1.05 * choice.whole["front"].translation


def test_asked_precision_is_reached_with_few_stretches_or_it_is_said_that_it_cannot_be() -> None:
    told = np.full((50, 6), 1e4)  # each alone: 10 mm, 10 mrad
    choice = choose_sections(made_up(told), np.ones(50), precision=Precision(translation=0.004))
    assert len(choice.stretches) == 7  # 10 mm / sqrt(7) = 3.8 mm
    assert choice.predicted["front"].translation == pytest.approx(0.01 / np.sqrt(7))
    choice = choose_sections(made_up(told), np.ones(50), precision=Precision(translation=0.001))
    assert "does not reach the precision" in choice.reason
    assert len(choice.stretches) >= 45


def test_what_was_told_already_counts_less() -> None:
    told = np.ones((30, 6))
    told[10:20, :3] = 1e6  # 1 mrad each
    told[20:, 3:] = 0.5e6  # 1.4 mm each
    wanted = Precision(rotation=0.51e-3, translation=0.72e-3)
    choice = choose_sections(made_up(told), np.ones(30), precision=wanted)
    assert [(choice.stretches < 20).sum(), (choice.stretches >= 20).sum()] == [4, 4]


def test_axes_that_nothing_tells_do_not_draw_in_the_whole_recording() -> None:
    told = np.full((40, 6), 1.0)
    told[[5, 6, 7]] = 1e7
    told[:, 5] = 1e-3  # no stretch tells this one to 20 cm
    choice = choose_sections(made_up(told), np.ones(40))
    assert choice.stretches.tolist() == [5, 6, 7]
    assert choice.whole["front"].unobservable == 1
    told[:, 3:] = 1e-3
    assert tells_no_place(made_up(told))


@pytest.mark.parametrize(
    ("text", "rotation", "translation"),
    [
        ("5mm", None, 0.005),
        ("0.02deg", np.deg2rad(0.02), None),
        (" 5 mm, 0.02 deg", np.deg2rad(0.02), 0.005),
        ("1mrad|2cm", 0.001, 0.02),
    ],
)
def test_precision_words(text: str, rotation: float | None, translation: float | None) -> None:
    found = parse_precision(text)
    assert found.rotation == (None if rotation is None else pytest.approx(rotation))
    assert found.translation == (None if translation is None else pytest.approx(translation))


@pytest.mark.parametrize(
    "text", ["", "5", "mm", "5 miles", "-1mm", "0deg", "5mm,6cm", "1.2.3mm", "nanmm", "1e999m"]
)
def test_precision_that_is_none(text: str) -> None:
    with pytest.raises(UsageError):
        parse_precision(text)


def test_words_and_values_of_a_plan() -> None:
    plan = planned_sections(thesis_case(), load_config(None, OFFLINE, precision="30mm,1deg"))
    assert isinstance(plan, SectionPlan)
    assert len(information_line(plan)) == len(plan.information)
    assert information_over_time(plan).sum() == pytest.approx(1.0, abs=0.05)
    values = plan_to_dict(plan)
    assert values["used_s"] == pytest.approx(plan.choice.seconds)
    assert values["cpu_s"] < values["cpu_s_of_all"]
    assert plan.choice.reason in choice_words(plan)
    drawn = told_over_time(plan)
    assert drawn.chosen.sum() == len(plan.choice.stretches)
    assert [duration_words(s) for s in (40, 300, 7200)] == ["40 s", "5 min", "2.0 h"]


class CountingFrames:
    """Pictures with corners before the middle, grey ones after; counts what is read."""

    def __init__(self, count: int) -> None:
        self.count, self.read = count, []

    def frames(self, indices, *, colour: bool = False):
        rng = np.random.default_rng(0)
        for index in np.asarray(indices).tolist():
            self.read.append(index)
            image = np.full((60, 80), 90, np.uint8)
            if index < self.count // 2:
                image = np.kron(rng.integers(0, 255, (12, 16), dtype=np.uint8), np.ones((5, 5), np.uint8))
            yield Frame(index, index * 10**8, image)


def test_one_picture_per_stretch_tells_whether_there_is_anything_to_follow() -> None:
    source = CountingFrames(800)
    camera = CameraStream("front", np.arange(800) * 10**8, source, 80, 60)
    texture = texture_over_time({"front": camera}, stretch_spans(0, 80 * 10**9, 8.0))
    assert len(source.read) == 10
    assert (texture[:5, 0] > 0.5).all()
    assert (texture[5:, 0] == 0).all()


def test_stretches_without_frames_have_no_texture() -> None:
    camera = CameraStream("front", np.arange(400) * 10**8, CountingFrames(800), 80, 60)
    texture = texture_over_time({"front": camera}, stretch_spans(0, 80 * 10**9, 8.0))
    assert (texture[:5, 0] > 0.5).all()
    assert (texture[5:, 0] == 0).all()


def test_frames_outside_of_the_sections_are_never_read() -> None:
    source = CountingFrames(800)
    camera = CameraStream("front", np.arange(800) * 10**8, source, 80, 60)
    cut = camera_between(camera, [(10**9, 2 * 10**9), (40 * 10**9, 41 * 10**9)])
    assert [frame.index for frame in cut.frames()] == list(range(22))
    assert source.read == [*range(10, 21), *range(400, 411)]


def test_nothing_bridges_the_gap_between_sections() -> None:
    world = sail(("front",), features=20, duration_s=20)
    measured = measurements(world)
    tracks = world.tracks["front"]
    seconds = (tracks.timestamps_ns - tracks.timestamps_ns[0]) * 1e-9
    used = (seconds < 6) | (seconds > 13)
    numbers = np.cumsum(used) - 1
    rows = used[tracks.frame_indices]
    part = replace(
        tracks.take(rows),
        timestamps_ns=tracks.timestamps_ns[used],
        frame_indices=numbers[tracks.frame_indices[rows]],
    )
    problem = assemble_problem(
        replace(measured, tracks={"front": part}), first_values(world), load_config(None, ()).adjustment
    ).problem
    gap = int(np.argmax(np.diff(problem.states.timestamps_ns)))
    factors = inertial_factors(problem, layout_of(problem))
    assert not factors.jacobian[gap, :9].any()
    assert not factors.residuals[gap, :9].any()
    assert factors.jacobian[gap, 9:].any()
    assert factors.jacobian[gap - 1, :9].any()
    middle = int(problem.states.timestamps_ns[gap : gap + 2].mean())
    assert not inside_states(problem, np.array([middle]))[0]
    # velocities at the edges are those of their own sections, not of the way across the gap
    speed = np.linalg.norm(problem.states.inertial.velocity_world[[gap, gap + 1]], axis=1)
    assert (speed < 4).all()
