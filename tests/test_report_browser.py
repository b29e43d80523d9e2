"""The report in a real browser: Debian's chromium, driven headless."""

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibrated_rigs import boat, without_vertical
from headless_browser import headless_browser, requests_of, serious_findings
from headless_browser import open_page as open_plainly
from report_folders import write_folder
from rigwake.report import build_report

By = pytest.importorskip("selenium.webdriver.common.by", reason="selenium is not installed").By
Keys = pytest.importorskip("selenium.webdriver.common.keys").Keys

TABS = ["rig", "extrinsics", "uncertainty", "residuals", "checks", "motion", "settings"]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    write_folder(folder / "good", duration_s=30)
    write_folder(folder / "lost", without_vertical(boat("base_link"), "port"), duration_s=30)
    return {name: build_report(folder / name) for name in ("good", "lost")}


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    with headless_browser(tmp_path_factory.mktemp("profile")) as session:
        yield session


def open_page(browser, page: Path, width: int = 1280, dark: bool = False) -> None:
    open_plainly(browser, page, width, dark)
    assert browser.execute_script("return document.documentElement.dataset.ready") == "yes"


def show(browser, tab: str) -> None:
    browser.find_element(By.ID, f"tab-{tab}").click()


def test_no_errors_no_requests_and_quick(browser, pages: dict[str, Path]) -> None:
    browser.get("about:blank")
    browser.get_log("performance")  # what came before, such as the browser's own start page
    browser.get_log("browser")
    open_page(browser, pages["good"])
    for tab in TABS:
        show(browser, tab)
        assert browser.find_element(By.ID, tab).is_displayed()
        assert sum(browser.find_element(By.ID, other).is_displayed() for other in TABS) == 1
    assert browser.get_log("browser") == []
    assert {url.partition("#")[0] for url in requests_of(browser)} == {pages["good"].as_uri()}
    load_ms = []
    for _ in range(3):  # the best of three: other programs may keep the machine busy
        open_page(browser, pages["good"])
        end = "return performance.getEntriesByType('navigation')[0].loadEventEnd"
        load_ms.append(browser.execute_script(end))
    assert 0 < min(load_ms) < 2000


@pytest.mark.parametrize("name", ["good", "lost"])
def test_the_rig_is_drawn_and_turns(browser, pages: dict[str, Path], name: str) -> None:
    open_page(browser, pages[name])
    canvas = browser.find_element(By.ID, "rig3d")

    def picture() -> np.ndarray:
        return cv2.imdecode(np.frombuffer(canvas.screenshot_as_png, np.uint8), cv2.IMREAD_COLOR).astype(int)

    before = picture()
    background = before[2, 2]
    assert (np.abs(before - background).sum(axis=2) > 60).mean() > 0.01
    for control in ("button[data-view=top]", "button[data-view=ahead]"):
        browser.find_element(By.CSS_SELECTOR, control).click()
        after = picture()
        assert (np.abs(after - before).sum(axis=2) > 60).mean() > 0.005, control
        before = after
    canvas.send_keys(Keys.ARROW_LEFT * 5)
    assert (np.abs(picture() - before).sum(axis=2) > 60).mean() > 0.005
    slider = browser.find_element(By.ID, "sigma")
    slider.send_keys(Keys.END)
    assert browser.find_element(By.ID, "sigma-value").text == "200"


def test_landmarks_are_drawn_and_can_be_hidden(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"])
    show(browser, "motion")
    drawn = "return Number(document.getElementById('path3d').dataset.drawn)"
    with_landmarks = browser.execute_script(drawn)
    browser.find_element(By.ID, "landmarks").click()
    assert browser.execute_script(drawn) == with_landmarks - 4  # a cloud per camera


def test_tabs_follow_the_keyboard(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"])
    first = browser.find_element(By.ID, "tab-rig")
    first.click()
    first.send_keys(Keys.ARROW_RIGHT)
    assert browser.switch_to.active_element.get_attribute("id") == "tab-extrinsics"
    browser.switch_to.active_element.send_keys(Keys.END)
    assert browser.switch_to.active_element.get_attribute("id") == "tab-settings"
    browser.switch_to.active_element.send_keys(Keys.ARROW_RIGHT)
    assert browser.switch_to.active_element.get_attribute("id") == "tab-rig"
    stops = browser.find_elements(By.CSS_SELECTOR, "[role=tab][tabindex='0']")
    assert len(stops) == 1


def test_copy_buttons_copy(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"])
    browser.execute_cdp_cmd(
        "Browser.grantPermissions", {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    )
    show(browser, "extrinsics")
    button = browser.find_element(By.CSS_SELECTOR, "#extrinsics button[data-copy]")
    button.click()
    wait = "const done = arguments[0]; navigator.clipboard.readText().then(done, (e) => done(String(e)))"
    copied = json.loads(browser.execute_async_script(wait))
    np.testing.assert_allclose(copied, boat().cameras["front"].rig_from_cam.matrix, atol=1e-12)
    assert "copied" in browser.find_element(By.ID, "announce").get_attribute("textContent")


def test_theme_follows_the_system_and_the_button(browser, pages: dict[str, Path]) -> None:
    def background() -> str:
        return browser.execute_script("return getComputedStyle(document.body).backgroundColor")

    open_page(browser, pages["good"])
    light = background()
    open_page(browser, pages["good"], dark=True)
    dark = background()
    assert light != dark
    browser.find_element(By.ID, "theme").click()
    assert background() == light


@pytest.mark.parametrize("width", [360, 390, 800])
def test_no_sideways_scrolling(browser, pages: dict[str, Path], width: int) -> None:
    for page in pages.values():
        open_page(browser, page, width)
        for tab in TABS:
            show(browser, tab)
            wide, visible = browser.execute_script(
                "return [document.documentElement.scrollWidth, document.documentElement.clientWidth]"
            )
            assert wide <= visible, tab


def test_overlays_can_be_hidden(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"])
    show(browser, "checks")
    overlay = browser.find_element(By.CSS_SELECTOR, "#pictures-horizon .picture svg")
    assert overlay.is_displayed()
    browser.find_element(By.CSS_SELECTOR, "input[data-hides=pictures-horizon]").click()
    assert not overlay.is_displayed()


def test_print_shows_every_panel(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"])
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert all(browser.find_element(By.ID, tab).is_displayed() for tab in TABS)
    assert not browser.find_element(By.ID, "tab-rig").is_displayed()


def test_paper_is_light_and_shows_views_of_hidden_panels(browser, pages: dict[str, Path]) -> None:
    open_page(browser, pages["good"], dark=True)
    drawn = "return document.getElementById('path3d').dataset.drawn"
    assert not browser.execute_script(drawn)
    browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})
    assert int(browser.execute_script(drawn)) > 10
    assert browser.execute_script("return document.documentElement.dataset.theme") is None
    assert sum(browser.find_element(By.ID, tab).is_displayed() for tab in TABS) == 1


def test_without_scripts_everything_is_there(browser, pages: dict[str, Path]) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    browser.get(pages["good"].as_uri())
    try:
        assert all(browser.find_element(By.ID, tab).is_displayed() for tab in TABS)
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})


@pytest.mark.parametrize(("name", "dark"), [("good", False), ("lost", True)], ids=["light", "dark"])
def test_accessibility(browser, pages: dict[str, Path], name: str, dark: bool) -> None:
    open_page(browser, pages[name], dark=dark)
    for tab in TABS:
        show(browser, tab)
        assert serious_findings(browser) == [], tab
