"""The report's page in a real browser: what one sees, and that nothing is fetched."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image, ImageColor

from bcrl.report import cli
from bcrl.report.figures import style
from bcrl.results.layout import FQI_METRICS
from tests.report.test_page import write_own
from tests.report.test_report import write_runs

NEEDED = "BCRL_BROWSER"  # set where a missing browser is an error, as in CI
SWITCHES = (
    *("headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run"),
    *("disable-background-networking", "disable-component-update", "disable-sync"),
)
WIDTH, HEIGHT = 1280, 900
pytestmark = pytest.mark.browser


def start_browser(profile: Path):
    """Chromium under its driver's control; skips where there is none."""
    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if not all(paths):
        why = "needs chromium and chromedriver (Debian: chromium-driver)"
        (pytest.fail if os.environ.get(NEEDED) else pytest.skip)(why)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for switch in (*SWITCHES, f"user-data-dir={profile}"):
        options.add_argument(f"--{switch}")
    options.set_capability(
        "goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"}
    )
    return webdriver.Chrome(options=options, service=Service(paths[1]))


class Page:
    """The page in a browser, asked as a reader would."""

    def __init__(self, driver, path: Path) -> None:
        self.driver, self.url = driver, path.as_uri()

    def open(self, width: int = WIDTH) -> None:
        size = {"width": width, "height": HEIGHT}
        more = {"deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size | more)
        self.driver.get("about:blank")
        self.events()
        self.driver.get(self.url)

    def find(self, selector: str):
        (found,) = self.driver.find_elements("css selector", selector)
        return found

    def texts(self, selector: str) -> list[str]:
        found = self.driver.find_elements("css selector", selector)
        return [element.text for element in found]

    def script(self, text: str, *arguments):
        return self.driver.execute_script(text, *arguments)

    def keys(self, *keys: str) -> None:
        self.driver.switch_to.active_element.send_keys(*keys)

    def focus(self, selector: str) -> None:
        self.script("arguments[0].focus()", self.find(selector))

    def hover(self, selector: str, x: float) -> None:
        """Move the mouse to a share of an element's width, at half its height."""
        from selenium.webdriver import ActionChains

        element = self.find(selector)
        centre = "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})"
        self.script(centre, element)
        offset = round((x - 0.5) * element.size["width"])
        chain = ActionChains(self.driver, duration=0)
        chain.move_to_element_with_offset(element, offset, 0).perform()

    def shot(self, selector: str) -> np.ndarray:
        """An element's pixels, (H, W, 3)."""
        picture = Image.open(io.BytesIO(self.find(selector).screenshot_as_png))
        return np.asarray(picture.convert("RGB"))

    def whole(self) -> np.ndarray:
        """The whole page's pixels, (H, W, 3)."""
        options = {"captureBeyondViewport": True, "format": "png"}
        found = self.driver.execute_cdp_cmd("Page.captureScreenshot", options)
        picture = Image.open(io.BytesIO(base64.b64decode(found["data"])))
        return np.asarray(picture.convert("RGB"))

    def events(self) -> dict[str, list[dict]]:
        """What the browser's network has reported since the last call."""
        found = defaultdict(list)
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            found[message["method"]].append(message["params"])
        return found

    def requests(self) -> list[str]:
        """The URLs requested since the last call, but for data inside the page."""
        events = self.events()
        urls = [e["request"]["url"] for e in events["Network.requestWillBeSent"]]
        urls += [e["url"] for e in events["Network.webSocketCreated"]]
        return [url for url in urls if not url.startswith("data:")]


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("runs")
    for env in FQI_METRICS:
        write_runs(root, env)
    write_own(root)
    assert cli.main(["--runs-dir", str(root), "--scale", "smoke"]) == 0
    return root


@pytest.fixture(scope="module")
def page(runs_dir, tmp_path_factory) -> Page:
    driver = start_browser(tmp_path_factory.mktemp("profile"))
    try:
        page = Page(driver, runs_dir / "figures/report_smoke.html")
        page.open()
        yield page
    finally:
        driver.quit()


@pytest.fixture(autouse=True)
def opened(page):
    """Every test begins with the page anew, and none leaves an error or a request."""
    page.open()
    yield
    assert page.driver.get_log("browser") == []
    assert set(page.requests()) <= {page.url}


RETURN = "#runs-1 [data-metric=return]"  # the maze's


def inked(pixels: np.ndarray, method: str) -> int:
    """How many pixels have a method's colour."""
    return int((pixels == ImageColor.getrgb(style.colour(method))).all(-1).sum())


def test_the_page_is_drawn(page):
    assert page.texts("h1") == ["Boosted curriculum RL, scale smoke"]
    titles = page.texts("#runs-1 figcaption, #runs-2 figcaption, #runs-3 figcaption")
    assert "error at the start, |Q − V*|" in titles
    pixels = page.whole()
    colours = pixels[::4, ::4].astype(int) @ (1 << 16, 1 << 8, 1)
    assert len(np.unique(colours)) > 500
    panel = page.shot("#runs-1 [data-metric=q_error]")
    for method in ("FQI", "C-FQI", "B-FQI", "BC-FQI"):
        assert inked(panel, method) > 100
    loaded = "(i) => i.complete && i.naturalWidth > 99"
    assert page.script(f"return [...document.images].every({loaded})")


def test_a_method_can_be_hidden(page):
    button = page.find("#runs-1 .method:nth-of-type(2)")
    assert (button.text, button.get_attribute("aria-pressed")) == ("C-FQI", "true")
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    hidden = page.driver.find_elements("css selector", f"{RETURN} [data-method=C-FQI]")
    assert hidden == []
    assert inked(page.shot(RETURN), "C-FQI") == 0 < inked(page.shot(RETURN), "BC-FQI")
    page.focus("#runs-1 .method:nth-of-type(2)")
    page.keys(" ")  # the keyboard shows it again
    assert inked(page.shot(RETURN), "C-FQI") > 100


def values(page: Page, selector: str) -> dict[str, float]:
    """What the tooltip in a panel says: method → value."""
    rows = page.driver.find_elements("css selector", f"{selector} .tip tr")
    cells = [
        [td.text for td in row.find_elements("css selector", "td")] for row in rows
    ]
    return {name: float(value.replace("−", "-")) for _, name, value, *_ in cells}


def expected(runs_dir: Path, env: str, metric: str, **at: int) -> dict[str, float]:
    """The same from the aggregate CSV."""
    kind = "aggregate_dqn" if "step" in at else "aggregate"
    table = pd.read_csv(runs_dir / f"figures/{kind}_smoke.csv")
    table = table[(table["env"] == env) & (table["metric"] == metric)]
    for column, value in at.items():
        table = table[table[column] == value]
    return dict(zip(table["variant"], table["mean"], strict=True))


def test_hovering_shows_the_aggregates_values(page, runs_dir):
    page.hover(f"{RETURN} svg", 0.5)
    (head,) = page.texts(f"{RETURN} .tip strong")
    iteration = int(head.split()[1])
    assert 5 < iteration < 16
    means = expected(runs_dir, "maze", "return", iteration=iteration)
    assert values(page, RETURN) == pytest.approx(means, rel=1e-4) and len(means) == 4
    tip, panel = page.find(f"{RETURN} .tip").rect, page.find(RETURN).rect
    assert (
        panel["x"] <= tip["x"] and panel["y"] < tip["y"] < panel["y"] + panel["height"]
    )


def test_arrow_keys_walk_through_the_values(page, runs_dir):
    panel = "#runs-3 [data-metric=return]"
    page.focus(f"{panel} svg")
    page.keys("\ue010", "\ue012")  # End, ArrowLeft
    assert page.texts(f"{panel} .tip strong") == ["step 4000"]
    means = expected(runs_dir, "my_<i>env", "return", step=4000)
    assert values(page, panel) == pytest.approx(means, rel=1e-4) and len(means) == 2


def press(page: Page, text: str) -> None:
    buttons = page.driver.find_elements("css selector", "#runs-1 button")
    (found,) = (button for button in buttons if button.text == text)
    found.click()


def tasks_on_axis(page: Page) -> list[str]:
    return [text for text in page.texts(f"{RETURN} text") if text.startswith("T")]


def test_seeds_median_and_zoom(page):
    centre = f"{RETURN} [data-method=C-FQI] .centre"
    before = page.find(centre).get_attribute("d")
    press(page, "median")
    assert page.find(centre).get_attribute("d") != before
    press(page, "single seeds")
    seeds = f"{RETURN} [data-method=C-FQI] .seed"
    assert len(page.driver.find_elements("css selector", seeds)) == 6
    page.focus(f"{RETURN} svg")
    page.keys("+")
    assert "T5" in tasks_on_axis(page) and "T1" not in tasks_on_axis(page)
    page.keys("\ue00c")  # Escape
    assert "T1" in tasks_on_axis(page)


def test_it_fits_a_telephone(page):
    page.open(width=400)
    assert page.script("return document.documentElement.scrollWidth") <= 400
    assert inked(page.shot(RETURN), "BC-FQI") > 50


def test_names_from_files_stay_text(page):
    assert "My <i>env, FQI" in page.texts("h2")
    found = "document.querySelectorAll('h2 i, main script')"
    assert page.script(f"return {found}.length") == 0


def test_it_can_be_read_without_scripts(page):
    disable = "Emulation.setScriptExecutionDisabled"
    page.driver.execute_cdp_cmd(disable, {"value": True})
    try:
        page.driver.get(page.url)
        assert page.find("#runs-3 noscript img").is_displayed()
        assert page.find("#runs-1 .claims").is_displayed()
    finally:
        page.driver.execute_cdp_cmd(disable, {"value": False})


def test_the_policy_forbids_requests(page):
    """What the other tests watch for would be seen, and would not get out."""
    url = "http://[::1]/x"
    image = "document.body.append(Object.assign(new Image(), {src: arguments[0]}))"
    page.script(image, url)
    failed = "fetch(arguments[0]).catch(() => arguments[1]())"
    page.driver.execute_async_script(failed, url)
    messages = [entry["message"] for entry in page.driver.get_log("browser")]
    assert any("img-src" in text for text in messages)
    assert any("default-src" in text for text in messages)
    events = page.events()
    sent = events["Network.requestWillBeSent"]
    reasons = {
        e["requestId"]: e.get("blockedReason") for e in events["Network.loadingFailed"]
    }
    sent = [e["requestId"] for e in sent if e["request"]["url"] == url]
    assert sent and all(reasons[each] == "csp" for each in sent)
