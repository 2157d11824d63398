"""A real browser for the pages: started, asked, looked at. Tests skip where it is not installed."""

import json
import shutil
from importlib import resources
from xml.etree import ElementTree

import pytest

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(not (BROWSER and DRIVER), reason="no chromium with chromedriver on this machine")


def start(*arguments: str):
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = BROWSER
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", *arguments):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    return Chrome(options=options, service=Service(DRIVER))


def open_page(driver, path, ready: str) -> None:
    """Open a page and wait until its script says so: ``ready`` is an expression."""
    driver.get(path.as_uri())
    _wait(driver, ready)


def reload_page(driver, ready: str) -> None:
    """Open a page like :func:`open_page`, in the page that is shown."""
    driver.refresh()
    _wait(driver, ready)


def _wait(driver, ready: str) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(driver, 20, 0.02).until(lambda d: d.execute_script(f"return Boolean({ready})"))


def choose(driver, element: str, text: str) -> None:
    from selenium.webdriver.support.ui import Select

    Select(driver.find_element("id", element)).select_by_visible_text(text)


def frame(driver) -> None:
    driver.execute_async_script("const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(done));")


def saved(driver, menus: str) -> dict[str, str]:
    """Return what each item of the visible chart menus would save, by file name."""
    from selenium.webdriver.support.ui import WebDriverWait

    chosen = driver.execute_script(
        "window.files = {}; URL.createObjectURL = blob => { window.last = blob; return 'blob:'; };"
        "HTMLAnchorElement.prototype.click = function () { window.last.text().then(t => { files[this.download] = t; }); };"
        "const all = [...document.querySelectorAll(arguments[0])].filter(m => m.checkVisibility());"
        "const choices = all.flatMap(m => [...m.options].filter(o => o.value).map(o => [m, o.value]));"
        "for (const [m, value] of choices) { m.value = value; m.dispatchEvent(new Event('change')); }"
        "return new Set(choices.map(([m, value]) => m.title + value)).size",
        menus,
    )
    WebDriverWait(driver, 20).until(lambda d: d.execute_script("return Object.keys(files).length") == chosen)
    return driver.execute_script("return files")


def saves_every_chart(driver) -> dict[str, str]:
    """One menu a canvas that is shown and no scale of another, each giving a picture with marks."""
    shown = "[...document.querySelectorAll('canvas:not(#legend)')].filter(c => c.checkVisibility()).length"
    files = saved(driver, ".saves select, .key select")
    drawn = [text for name, text in files.items() if name.endswith(".svg")]
    assert len(drawn) == driver.execute_script(f"return {shown}") > 0
    for text in drawn:
        assert {"path", "text"} <= {e.tag.split("}")[1] for e in ElementTree.fromstring(text).iter()}
    return files


def complaints(driver) -> list[dict]:
    """Return the console's messages, except those about frequent reading of pixels, which only tests do."""
    said = [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    return [entry for entry in said if "using getImageData" not in entry["message"]]


def asked_outside(driver) -> list[str]:
    """Return addresses outside of the page that it requested."""
    messages = (json.loads(entry["message"])["message"] for entry in driver.get_log("performance"))
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    return [url for url in asked if not url.startswith(("file:", "data:", "chrome:"))]


def serious_findings(driver) -> dict[str, list[str]]:
    """Return the serious and critical findings of axe-core, by rule, with every section open.

    Of the rows of a table with the same markup, two are tested (they may differ in their background), because the time
    grows with the square of the number of cells. The page is tested at two widths and in both themes. The window contains the complete page, because the packaged
    axe reports the contrast of parts outside the window as unknown.
    """
    axe = pytest.importorskip("axe_selenium_python", reason="axe-selenium-python is not installed")
    source = resources.files(axe) / "node_modules" / "axe-core" / "axe.min.js"
    driver.execute_script(source.read_text(encoding="utf-8"))
    driver.set_script_timeout(120)  # a busy machine: axe looks at every cell of every table
    # details that share a name close each other
    opened = "for (const d of document.querySelectorAll('details')) { d.removeAttribute('name'); d.open = true; }"
    fewer = """for (const body of document.querySelectorAll('tbody')) {
      const seen = {};
      for (const row of [...body.rows]) {
        const markup = row.outerHTML.replace(/>[^<]*/g, '>');
        seen[markup] = (seen[markup] || 0) + 1;
        if (seen[markup] > 2) row.remove();
      }
    }
    document.querySelectorAll('.tall table').forEach(t => { t.style.height = '60rem'; });"""  # their boxes still scroll
    high = "scrollTo(0, 0); return document.documentElement.scrollHeight"
    found = {}
    try:
        driver.execute_script(opened)
        driver.execute_script(fewer)
        for width, theme in ((1440, "light"), (390, "light"), (390, "dark"), (1440, "dark")):
            set_scheme(driver, theme)
            set_width(driver, width)
            set_width(driver, width, driver.execute_script(high) + 100)
            # colours alone depend on the theme; rules that find nothing would be a list of every element
            only = {"runOnly": {"type": "rule", "values": ["color-contrast"]}} if theme == "dark" else {}
            violations = driver.execute_async_script(
                "const [options, done] = arguments; axe.run(options, (error, audit) => done(error ? String(error) : audit.violations));",
                {"resultTypes": ["violations"], **only},
            )
            found |= {
                f"{v['id']}, {width} px, {theme}": [n["html"][:120] for n in v["nodes"]]
                for v in violations
                if v["impact"] in ("serious", "critical")
            }
    finally:
        set_scheme(driver)
        usual_width(driver)
    return found


def set_width(driver, width: int, height: int = 1000, *, mobile: bool = False) -> None:
    driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile},
    )
    frame(driver)


def usual_width(driver) -> None:
    driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def extents(driver, width: int, views: str) -> tuple[float, list[float]]:
    """Width of the page, and right edge of each of its views (a CSS selector), in a window of this width [px]."""
    set_width(driver, width)
    try:
        page = driver.execute_script("return document.documentElement.scrollWidth")
        rights = driver.execute_script(
            "return [...document.querySelectorAll(arguments[0])].map(c => c.getBoundingClientRect().right)", views
        )
        return page, rights
    finally:
        usual_width(driver)


def papers(driver, canvas: str) -> list[list[int]]:
    """First pixel of a canvas in the light and in the dark scheme."""
    pixels = []
    for scheme in ("light", "dark"):
        set_scheme(driver, scheme)
        frame(driver)
        script = (
            "return Array.from(document.getElementById(arguments[0]).getContext('2d').getImageData(1, 1, 1, 1).data)"
        )
        pixels.append(driver.execute_script(script, canvas))
    set_scheme(driver)
    return pixels


def set_scheme(driver, *schemes: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme} for scheme in schemes]
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    frame(driver)


class PageLaws:
    """Checks of every page, for which the module provides the page's ``driver``.

    ``ready`` is true once its script is done, ``views`` are what may not overflow, ``static`` stands without scripts.
    """

    ready = ""
    views = ""
    static: tuple[str, ...] = ()

    def papers(self, driver) -> list[list[int]]:
        """Colour of the page in the light and in the dark scheme."""
        raise NotImplementedError

    def test_nothing_is_said_on_the_console_and_nothing_leaves_the_page(self, driver):
        assert complaints(driver) == []
        assert asked_outside(driver) == []

    def test_no_serious_finding_of_accessibility(self, driver):
        assert serious_findings(driver) == {}

    @pytest.mark.parametrize("width", [1440, 768, 390])
    def test_nothing_overflows(self, driver, width):
        page, rights = extents(driver, width, self.views)
        assert page <= width
        assert rights
        assert max(rights) <= width

    def test_every_chart_can_be_saved(self, driver):
        saves_every_chart(driver)

    def test_dark_and_light(self, driver):
        assert [paper[:3] for paper in self.papers(driver)] == [[255, 255, 255], [23, 23, 23]]

    def test_with_scripts_off_tables_and_figures_stand(self, driver):
        driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
        try:
            driver.refresh()
            assert not driver.find_element("id", "explorer").is_displayed()
            assert all(driver.find_element("css selector", place).is_displayed() for place in self.static)
        finally:
            driver.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
            reload_page(driver, self.ready)
