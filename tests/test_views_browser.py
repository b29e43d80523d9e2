"""The live page in a real browser: Debian's chromium, driven headless."""

import json
import shutil
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest

from live_pages import Ticker, live_server
from rigwake.views.serve.server import LiveServer, ServerThread

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.chrome.options import Options  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1000,700",
)
BUTTONS = {"panorama": "panorama", "topdown": "topdown", "camera": "camera", "bowl": "bowl-button"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator:
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("chromium and chromium-driver are not installed")
    options = Options()
    options.binary_location = binary
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    session = webdriver.Chrome(options=options, service=Service(driver))
    yield session
    session.quit()


@pytest.fixture
def page() -> Iterator[tuple[LiveServer, Ticker]]:
    server, ticker = live_server()
    with ServerThread(server):
        ticker.start()
        yield server, ticker
        ticker.ended.set()


def data(browser, name: str) -> str:
    return browser.execute_script("return document.body.dataset[arguments[0]] || ''", name)


def wait(browser, condition, seconds: float = 20.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        notes = browser.execute_script("return JSON.stringify(document.body.dataset)")
        assert time.monotonic() < until, f"{notes} {browser.get_log('browser')}"
        time.sleep(0.05)


def canvas_grey(browser, name: str) -> np.ndarray:
    """A coarse picture of what a canvas shows."""
    script = """const c = document.createElement('canvas'); c.width = 64; c.height = 32;
    const pen = c.getContext('2d'); pen.drawImage(document.getElementById(arguments[0]), 0, 0, 64, 32);
    return Array.from(pen.getImageData(0, 0, 64, 32).data)"""
    return np.array(browser.execute_script(script, name)).reshape(32, 64, 4)[..., :3].mean(axis=2)


def test_page_shows_all_four_views_and_survives(browser, page) -> None:
    server, ticker = page
    browser.get(server.address)
    seen = {}
    for view, button in BUTTONS.items():
        browser.find_element(By.ID, button).click()
        wait(browser, lambda view=view: data(browser, "shown") == view)
        canvas = "bowl" if view == "bowl" else "flat"
        # a browser that draws without a graphics card may need seconds for the first picture
        wait(browser, lambda canvas=canvas: canvas_grey(browser, canvas).std() > 4)
        time.sleep(0.4)
        seen[view] = canvas_grey(browser, canvas)
    assert len({image.tobytes() for image in seen.values()}) == 4
    ages = []
    for _ in range(10):
        ages.append(float(data(browser, "age")))
        time.sleep(0.1)
    assert np.median(ages) < 0.5
    # the bowl turns at the browser's rate, without new pictures
    before = int(data(browser, "bowl_draws"))
    browser.execute_script("surround.bowl.azimuth += 1.2")
    wait(browser, lambda: int(data(browser, "bowl_draws")) > before + 2)
    assert np.abs(canvas_grey(browser, "bowl") - seen["bowl"]).mean() > 2
    # a missing camera is named
    ticker.missing["left"] = "black"
    browser.find_element(By.ID, "panorama").click()
    wait(browser, lambda: "left: black" in browser.find_element(By.ID, "words").text)
    # a dropped socket
    browser.execute_script("surround.state.socket.close()")
    wait(browser, lambda: data(browser, "connections") == "2" and data(browser, "state") == "open")
    count = int(data(browser, "frames"))
    wait(browser, lambda: int(data(browser, "frames")) > count + 2)
    assert not [
        entry
        for entry in browser.get_log("browser")
        if entry["level"] == "SEVERE" and "favicon" not in str(entry)
    ]


def test_page_survives_a_restart_of_the_server(browser) -> None:
    server, ticker = live_server()
    with ServerThread(server):
        ticker.start()
        browser.get(server.address)
        wait(browser, lambda: int(data(browser, "frames") or 0) > 2)
        port = server.port
    ticker.ended.set()
    wait(browser, lambda: data(browser, "state") == "lost")
    again, ticker = live_server(port)
    with ServerThread(again):
        ticker.start()
        count = int(data(browser, "frames"))
        wait(browser, lambda: data(browser, "state") == "open" and int(data(browser, "frames")) > count + 2)
    ticker.ended.set()


def test_slow_viewer_sees_fresh_pictures_beside_a_fast_one(browser, page) -> None:
    server, _ = page
    browser.get(server.address + "?fps=2")
    first = browser.current_window_handle
    browser.switch_to.new_window("window")
    browser.get(server.address)
    wait(browser, lambda: int(data(browser, "frames") or 0) > 5)
    browser.switch_to.window(first)
    wait(browser, lambda: int(data(browser, "frames") or 0) > 3)
    ages, numbers = [], []
    for _ in range(5):
        count = data(browser, "frames")
        wait(browser, lambda count=count: data(browser, "frames") != count)
        ages.append(float(data(browser, "age")))
        numbers.append(int(data(browser, "number")))
    print("ages", ages, "numbers", numbers)
    assert np.median(ages) <= 0.3
    assert np.median(np.diff(numbers)) >= 3  # pictures between are skipped, not queued


def test_server_listens_on_this_machine_only(page) -> None:
    server, _ = page
    assert server.host == "127.0.0.1"
    addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in addresses - {"127.0.0.1"}:
        if address.startswith("127."):
            continue
        with pytest.raises(OSError, match=r".+"):
            socket.create_connection((address, server.port), timeout=1).close()
    assert json.dumps(server.address)
