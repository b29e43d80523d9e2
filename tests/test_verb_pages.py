"""The pages of all verbs: whole without scripts and network, fit for a phone, the dark, paper and screen readers."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibrated_rigs import boat
from headless_browser import headless_browser, open_page, requests_of, serious_findings
from rigwake.report.charts import Series, line_chart
from rigwake.report.html_page import html_page, picture, table
from rigwake.report.strip_charts import interval_chart, presence_chart, rig_from_above
from verb_pages import QUICK, write_pages

WIDTHS = (390, 1280)


@pytest.mark.parametrize("verb", ["diff", "evaluate", "fleet", "handeye", "inspect", "odometry"])
def test_a_page_is_whole_and_makes_up_no_number(verb: str) -> None:
    page = QUICK[verb]()
    assert page.lower().startswith("<!doctype html>")
    assert "Content-Security-Policy" in page
    assert page.count("<svg") > 1 or verb == "fleet"  # a vessel with one recording has no chart
    words = re.sub(r"<style>.*?</style>|data:[^\"]*", "", page, flags=re.DOTALL)
    assert not re.search(r"\bnan\b|\binf\b|None", words)
    assert not re.search(r"https?://", words)


def test_names_of_strangers_are_text() -> None:
    evil = "<script>alert(1)</script>"
    page = html_page(
        evil, [table(evil, [evil, "b"], [[evil, "1"]]), picture(np.zeros((4, 4), np.uint8), evil)], evil
    )
    chart = line_chart(evil, evil, evil, [Series(evil, np.arange(3.0), np.arange(3.0))])
    for text in (page, chart, interval_chart(evil, evil, {evil: (1.0, 0.1)})):
        assert "<script" not in text
        assert "&lt;script&gt;" in text


def test_a_gap_breaks_the_bar_of_its_sensor_alone() -> None:
    stamps = np.arange(100) * 10**8
    with_gap = np.delete(stamps, np.arange(40, 60))
    drawn = presence_chart("sensors", {"imu": stamps, "gps": with_gap, "empty": stamps[:0]})
    assert drawn.count("<rect") == 3
    assert "empty" not in drawn


def test_a_value_without_sigma_has_a_dot_and_no_bar() -> None:
    drawn = interval_chart("offsets", "ms", {"a": (1.0, 0.1), "b": (2.0, np.nan), "c": (np.nan, np.nan)})
    assert drawn.count("<circle") == 2
    assert drawn.count('class="line') == 2
    assert interval_chart("offsets", "ms", {"c": (np.nan, 1.0)}) == ""


def test_every_camera_is_on_the_rig_seen_from_above() -> None:
    rig = {name: camera.rig_from_cam for name, camera in boat().cameras.items()}
    drawn = rig_from_above("rig", [rig, rig])
    assert all(name in drawn for name in rig)
    assert drawn.count("<circle") == 2 * len(rig)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_pages(tmp_path_factory.mktemp("pages"))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    with headless_browser(tmp_path_factory.mktemp("profile")) as session:
        yield session


@pytest.mark.slow
def test_all_pages_in_a_browser(browser, pages: dict[str, Path]) -> None:
    assert len(pages) == 11
    browser.get("about:blank")
    browser.get_log("browser")  # what came before, such as the browser's own start page
    requests_of(browser)
    for verb, page in pages.items():
        for width in WIDTHS:
            for dark in (False, True):
                open_page(browser, page, width, dark)
                wide, visible = browser.execute_script(
                    "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
                )
                assert wide <= visible, (verb, width)
                if width == WIDTHS[0]:
                    assert serious_findings(browser) == [], (verb, dark)
        assert browser.get_log("browser") == [], verb
        assert {url.partition("#")[0] for url in requests_of(browser)} == {page.as_uri()}, verb


@pytest.mark.slow
def test_pages_print_light(browser, pages: dict[str, Path]) -> None:
    for verb in ("inspect", "handeye", "diff"):
        open_page(browser, pages[verb], dark=True)
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        background = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
        assert background == "rgb(255, 255, 255)", verb
