"""The report's page in a real browser: what one sees, and that nothing is fetched."""

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

from bcrl.report.figures import style
from bcrl.results.layout import FQI_METRICS
from tests.report.runs import report, write_fqi
from tests.report.test_page import write_own

NEEDED = "BCRL_BROWSER"  # set where a missing browser is an error, as in CI
SWITCHES = "headless no-sandbox disable-gpu disable-quic no-first-run disable-sync "
SWITCHES += "disable-background-networking disable-component-update"
RETURN = "#runs-1 [data-metric=return]"  # the maze's
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
    for switch in (*SWITCHES.split(), f"user-data-dir={profile}"):
        options.add_argument(f"--{switch}")
    logs = {"browser": "ALL", "performance": "ALL"}
    options.set_capability("goog:loggingPrefs", logs)
    return webdriver.Chrome(options=options, service=Service(paths[1]))


class Page:
    """The page in a browser, asked as a reader would."""

    def __init__(self, driver, path: Path) -> None:
        self.driver, self.url = driver, path.as_uri()
        self.script = driver.execute_script

    def open(self) -> None:
        size = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.driver.get("about:blank")
        self.events()
        self.driver.get(self.url)

    def all(self, selector: str) -> list:
        return self.driver.find_elements("css selector", selector)

    def find(self, selector: str):
        (found,) = self.all(selector)
        return found

    def texts(self, selector: str) -> list[str]:
        return [element.text for element in self.all(selector)]

    def press(self, selector: str, *keys: str) -> None:
        """Focus an element, then press keys."""
        self.script("arguments[0].focus()", self.find(selector))
        self.driver.switch_to.active_element.send_keys(*keys)

    def click(self, text: str) -> None:
        """Click the maze's button of this text."""
        (found,) = (each for each in self.all("#runs-1 button") if each.text == text)
        found.click()

    def hover(self, selector: str) -> None:
        """Move the mouse to the middle of an element."""
        from selenium.webdriver import ActionChains

        element = self.find(selector)
        centre = "arguments[0].scrollIntoView({block: 'center', behavior: 'instant'})"
        self.script(centre, element)
        ActionChains(self.driver, duration=0).move_to_element(element).perform()

    def values(self, selector: str) -> dict[str, float]:
        """What the tooltip in a panel says: method → value."""
        cells = f"{selector} .tip td:nth-child"
        names, values = self.texts(f"{cells}(2)"), self.texts(f"{cells}(3)")
        numbers = [float(value.replace("−", "-")) for value in values]
        return dict(zip(names, numbers, strict=True))

    def inked(self, selector: str, method: str) -> int:
        """How many of an element's pixels have a method's colour."""
        image = Image.open(io.BytesIO(self.find(selector).screenshot_as_png))
        pixels = np.asarray(image.convert("RGB"))  # (H, W, 3)
        colour = ImageColor.getrgb(style.colour(method))
        return int((pixels == colour).all(-1).sum())

    def events(self) -> dict[str, list[dict]]:
        """What the browser's network has reported since the last call."""
        found = defaultdict(list)
        for entry in self.driver.get_log("performance"):
            message = json.loads(entry["message"])["message"]
            found[message["method"]].append(message["params"])
        return found


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("runs")
    for env in FQI_METRICS:
        write_fqi(root, env)
    write_own(root)
    assert report(root) == 0
    return root


@pytest.fixture(scope="module")
def browser(runs_dir, tmp_path_factory) -> Page:
    driver = start_browser(tmp_path_factory.mktemp("profile"))
    try:
        yield Page(driver, runs_dir / "figures/report_smoke.html")
    finally:
        driver.quit()


@pytest.fixture
def page(browser) -> Page:
    """The page anew for every test; none leaves an error or a request."""
    browser.open()
    yield browser
    assert browser.driver.get_log("browser") == []
    events = browser.events()
    urls = [e["request"]["url"] for e in events["Network.requestWillBeSent"]]
    urls += [e["url"] for e in events["Network.webSocketCreated"]]
    assert {url for url in urls if not url.startswith("data:")} <= {browser.url}


def test_the_page_is_drawn(page):
    assert page.texts("h1") == ["Boosted curriculum RL, scale smoke"]
    titles = page.texts("#runs-1 figcaption, #runs-2 figcaption, #runs-3 figcaption")
    assert "error at the start, |Q − V*|" in titles
    assert "My <i>env, FQI" in page.texts("h2")  # names from files stay text
    assert page.all("h2 i, main script") == []
    for method in ("FQI", "C-FQI", "B-FQI", "BC-FQI"):
        assert page.inked("#runs-1 [data-metric=q_error]", method) > 100
    loaded = "(i) => i.complete && i.naturalWidth > 99"
    assert page.script(f"return [...document.images].every({loaded})")


def test_a_method_can_be_hidden(page):
    button = page.find("#runs-1 .method:nth-of-type(2)")
    assert (button.text, button.get_attribute("aria-pressed")) == ("C-FQI", "true")
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    assert page.all(f"{RETURN} [data-method=C-FQI]") == []
    assert page.inked(RETURN, "C-FQI") == 0 < page.inked(RETURN, "BC-FQI")
    page.press("#runs-1 .method:nth-of-type(2)", " ")  # the keyboard shows it again
    assert page.inked(RETURN, "C-FQI") > 100


def test_values_are_the_aggregates(page, runs_dir):
    page.hover(f"{RETURN} svg")
    (head,) = page.texts(f"{RETURN} .tip strong")
    iteration = int(head.split()[1])
    assert 5 < iteration < 16
    table = pd.read_csv(runs_dir / "figures/aggregate_smoke.csv")
    where = f"env == 'maze' and metric == 'return' and iteration == {iteration}"
    means = table.query(where).set_index("variant")["mean"].to_dict()
    assert page.values(RETURN) == pytest.approx(means, rel=1e-4) and len(means) == 4
    panel = "#runs-3 [data-metric=return]"
    page.press(f"{panel} svg", "\ue010", "\ue012")  # End, ArrowLeft
    assert page.texts(f"{panel} .tip strong") == ["step 4000"]


def test_seeds_median_and_zoom(page):
    centre = f"{RETURN} [data-method=C-FQI] .centre"
    before = page.find(centre).get_attribute("d")
    page.click("median")
    assert page.find(centre).get_attribute("d") != before
    page.click("single seeds")
    assert len(page.all(f"{RETURN} [data-method=C-FQI] .seed")) == 6
    page.press(f"{RETURN} svg", "+")
    shown = page.texts(f"{RETURN} text")
    assert "T5" in shown and "T1" not in shown
    page.press(f"{RETURN} svg", "\ue00c")  # Escape
    assert "T1" in page.texts(f"{RETURN} text")


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
    sent = [
        e for e in events["Network.requestWillBeSent"] if e["request"]["url"] == url
    ]
    failures = events["Network.loadingFailed"]
    reasons = {each["requestId"]: each.get("blockedReason") for each in failures}
    assert sent and all(reasons[each["requestId"]] == "csp" for each in sent)
