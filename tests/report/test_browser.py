"""The report's page in a real browser: what one sees, and that nothing is fetched."""

import io
import json
import os
import shutil
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

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
SVG = "{http://www.w3.org/2000/svg}"
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
        self.media("prefers-color-scheme", "light")
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

    def media(self, feature: str, value: str, medium: str = "") -> None:
        """What the page is shown on, and what the reader prefers."""
        media = {"media": medium, "features": [{"name": feature, "value": value}]}
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)

    def wait(self, until: Callable[[], bool]) -> None:
        """Until something is so; TimeoutException after 20 seconds."""
        from selenium.webdriver.support.wait import WebDriverWait

        WebDriverWait(self.driver, 20, 0.05).until(lambda _: until())

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
    (root / "figures").mkdir()
    frames = [Image.new("P", (100, 100), colour) for colour in (0, 1)]
    animation = root / "figures/agent_maze_FQI_smoke.gif"
    frames[0].save(animation, save_all=True, append_images=frames[1:], duration=99)
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
    assert any(title.startswith("error at the start, |Q − V*|") for title in titles)
    assert "my_<i>env, FQI" in page.texts("h2")  # names from files stay text
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
    (about,) = page.texts("#runs-1 .about")
    assert "median" in about and "quartiles" in about and "single seeds" in about
    page.press(f"{RETURN} svg", "+")
    shown = page.texts(f"{RETURN} text")
    assert "T5" in shown and "T1" not in shown
    page.press(f"{RETURN} svg", "+" * 60)  # no closer than one iteration
    texts = page.texts(f"{RETURN} text")
    assert len({*texts}) == len(texts) and len(texts) < 20
    page.press(f"{RETURN} svg", "\ue00c")  # Escape
    assert "T1" in page.texts(f"{RETURN} text")


def test_values_are_announced(page):
    """Chart and tables have roles and names; arrow keys and taps change a status."""
    chart = page.find(f"{RETURN} svg")
    assert chart.aria_role == "application" and "return" in chart.accessible_name
    status = "#runs-1 [role=status]"
    page.press(f"{RETURN} svg", "\ue011")  # Home
    told = page.find(status).get_attribute("textContent")
    assert told.startswith("iteration 1: FQI ") and "; BC-FQI " in told
    page.press(f"{RETURN} svg", "\ue014")  # ArrowRight
    assert "iteration 2: " in page.find(status).get_attribute("textContent")
    tables = "#runs-1 .scroll table"
    assert {table.aria_role for table in page.all(tables)} == {"table"}
    assert len(page.all(f"{tables} caption")) == len(page.all(tables)) > 2
    heads = page.all(f"{tables} tbody th")
    assert {head.aria_role for head in heads} == {"rowheader"}


def test_fingers(page):
    """A tap shows values that stay until the next tap elsewhere; − undoes +."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.pointer_input import PointerInput

    def tap(selector: str) -> None:
        page.script(
            "arguments[0].scrollIntoView({block: 'center'})", page.find(selector)
        )
        finger = PointerInput("touch", "finger")
        actions = ActionChains(page.driver, duration=0, devices=[finger])
        pointer = actions.w3c_actions.pointer_action
        pointer.move_to(page.find(selector)).pointer_down().pointer_up()
        actions.perform()

    tap(f"{RETURN} svg")
    assert len(page.values(RETURN)) == 4
    tap("#runs-1 [data-metric=q_error] svg")
    assert len(page.values("#runs-1 [data-metric=q_error]")) == 4
    assert page.all(f"{RETURN} .tip") == []
    shown = page.texts(f"{RETURN} text")
    tap("#runs-1 [aria-label='zoom in']")
    assert page.texts(f"{RETURN} text") != shown
    assert page.all(f"{RETURN} .tip") == []
    tap("#runs-1 [aria-label='zoom out']")
    assert page.texts(f"{RETURN} text") == shown


def test_panels_are_downloaded(page, runs_dir, tmp_path):
    """CSV with the aggregate's values, SVG and PNG in light colours with a legend."""
    where = {"behavior": "allow", "downloadPath": str(tmp_path)}
    page.driver.execute_cdp_cmd("Browser.setDownloadBehavior", where)
    page.media("prefers-color-scheme", "dark")
    page.find("#runs-1 .method:nth-of-type(2)").click()
    saved = {}
    for kind in ("CSV", "SVG", "PNG"):
        path = tmp_path / f"maze-FQI-return.{kind.lower()}"
        page.press(f"{RETURN} [aria-label$='as {kind}']", " ")
        page.wait(path.exists)
        saved[kind] = path
    table = pd.read_csv(saved["CSV"])
    assert set(table["variant"]) == {"FQI", "B-FQI", "BC-FQI"}  # those that are shown
    aggregate = pd.read_csv(runs_dir / "figures/aggregate_smoke.csv")
    keys = ["variant", "metric", "task", "iteration"]
    both = table.merge(aggregate.query("env == 'maze'"), on=keys, validate="1:1")
    assert len(both) == len(table) == 60
    np.testing.assert_allclose(both["mean_x"], both["mean_y"], rtol=1e-6)
    assert (table["interval_low"] <= table["interval_high"]).all()
    drawing = ElementTree.parse(saved["SVG"])
    texts = {text.text for text in drawing.iter(f"{SVG}text")}
    assert texts >= {"discounted return", "optimum", "FQI", "B-FQI", "BC-FQI", "T10"}
    assert "mean over seeds, band: 95 % bootstrap interval" in texts
    colours = {path.get("stroke") for path in drawing.iter(f"{SVG}path")}
    light = ImageColor.getrgb(style.colour("BC-FQI"))
    assert f"rgb{light}" in colours
    width, height = (float(drawing.getroot().get(k)) for k in ("width", "height"))
    image = Image.open(saved["PNG"]).convert("RGB")
    assert image.size == (int(width * 3), int(height * 3))
    pixels = np.asarray(image)
    assert (pixels[0, 0] == 255).all() and (pixels == light).all(-1).sum() > 500


def test_nothing_is_wider_than_a_phone(page):
    size = {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.driver.get(page.url)
    wider = "return [...document.querySelectorAll('body *')].filter((e) => "
    wider += "e.getBoundingClientRect().right > 400 && !e.closest('thead, .unseen'))"
    assert page.script(wider) == []


def test_all_of_it_is_printed(page):
    """On A4 nothing is cut and nothing stays folded; panels are drawn anew for it."""
    page.script("window.dispatchEvent(new Event('beforeprint'))")
    width = "return document.querySelector('.panel svg').viewBox.baseVal.width"
    assert page.script(width) == 340
    page.script("window.dispatchEvent(new Event('afterprint'))")
    assert page.script(width) > 340
    folded = "return [...document.querySelectorAll('details pre')].filter("
    folded += "(e) => !e.checkVisibility())"
    assert page.script(folded)
    size = {"width": 703, "height": 1016, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.media("prefers-color-scheme", "dark", "print")
    cut = "return [...document.querySelectorAll('main *')].filter((e) => "
    cut += "e.scrollWidth > e.clientWidth + 1 && e.clientWidth || "
    cut += "e.getBoundingClientRect().right > 704).map((e) => e.outerHTML)"
    assert page.script(cut) == []
    assert page.script(folded) == []
    background = "return getComputedStyle(document.body).backgroundColor"
    assert page.script(background) == "rgb(255, 255, 255)"


def test_animations_stop(page):
    """At once where motion is reduced, else by a button, which also plays them."""
    moving = "return document.querySelector('.moving img').currentSrc.slice(5, 14)"
    for value, kinds in (("reduce", ("png", "gif")), ("no-preference", ("gif", "png"))):
        page.media("prefers-reduced-motion", value)
        page.driver.get(page.url)
        for kind in kinds:
            page.wait(lambda kind=kind: page.script(moving) == f"image/{kind}")
            page.press("#agents button", " ")


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
