"""Debian's chromium, driven headless, for tests of pages."""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

AXE = Path(__file__).parent.parent / ".venv" / "axe" / "node_modules" / "axe-core" / "axe.min.js"
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,1000",
)


@contextmanager
def headless_browser(profile: Path) -> Iterator[Any]:
    """A session that logs the console and every request; skips the test where there is no browser."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    from selenium.webdriver.chrome.options import Options
    from selenium.webdriver.chrome.service import Service

    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("chromium and chromium-driver are not installed")
    options = Options()
    options.binary_location = binary
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    session = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield session
    finally:
        session.quit()


def open_page(browser: Any, page: Path, width: int = 1280, dark: bool = False) -> None:
    """Load a page from disk, on a screen so wide, in one of both colour schemes."""
    metrics = {"width": width, "height": 1000, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": [scheme]})
    browser.get(page.as_uri())


def requests_of(browser: Any) -> set[str]:
    """Addresses that were asked for since this was last called."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    sent = [m["params"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    return {m["request"]["url"] for m in sent if not m["request"]["url"].startswith("data:")}


def serious_findings(browser: Any) -> list[tuple[str, str, str]]:
    """What axe-core finds on the open page that is serious or critical; skips the test where it is not installed."""
    if not AXE.is_file():
        pytest.skip("axe-core is not installed: npm install --prefix .venv/axe axe-core")
    browser.execute_script(AXE.read_text())
    run = (
        "const done = arguments[0]; axe.run(document).then((r) => done(r.violations), (e) => done(String(e)))"
    )
    return [
        (v["id"], v["impact"], v["nodes"][0]["html"][:150])
        for v in browser.execute_async_script(run)
        if v["impact"] in ("serious", "critical")
    ]
