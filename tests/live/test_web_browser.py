"""The tap's page in a real browser, on a simulated modem and on logs that are played."""

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.live.feed import Feed
from aerpaw_cmp.live.ports import TapStatus
from aerpaw_cmp.live.web import Address, Limits, Page, WebServer
from aerpaw_cmp.maps.grid import Grid
from aerpaw_cmp.report.live import live_map, live_page
from tests.report.browsing import (
    complaints,
    extents,
    frame,
    needs_browser,
    saves_every_chart,
    serious_findings,
    set_scheme,
    start,
)
from tests.report.conftest import make_site

pytest.importorskip("selenium", reason="selenium is not installed")
pytestmark = needs_browser

ROOT = Path(__file__).resolve().parents[2]
SECOND = 1_000_000_000


def made_map():
    site = make_site()
    grid = Grid.over_area((-300.0, 300.0, -300.0, 300.0), 30.0)
    shape = (2, len(grid.north_m), len(grid.east_m))
    distance = np.broadcast_to(np.hypot(*np.meshgrid(grid.east_m, grid.north_m)), shape)
    rank = np.clip(4 - distance // 100, 0, 4).astype(int)
    level = np.where(rank > 0, -40.0 - distance / 10, np.nan)
    return live_map(site, next(iter(site.towers)), 100.0, (30.0, 90.0), grid, (rank, level))


class Flight:
    """A page fed by hand: a flight that goes east, a row at a time."""

    def __init__(self, names=("modem",), background=None, port=0, token=None):
        self.now_ns = self.start_ns = 1_800_000_000 * SECOND
        self.count = 0
        self.feed = Feed(list(names), lambda: self.now_ns - self.start_ns, lambda: self.now_ns)
        self.names = names
        self.server = WebServer(self.feed, Page(*live_page(background, "<b>made up</b>")), Address("127.0.0.1", port), token=token,
                                limits=Limits(tick_s=0.02))  # fmt: skip
        for modem in range(len(names)):
            self.feed.put(
                modem, {"kind": "header", "utc_ns": self.now_ns, "mono_ns": 0, "port": {"device": "/dev/pts/9"}}
            )

    def fly(self, n=1, *, modem=0, rank=2, predicted=3, rsrp=-90.0, **fields):
        for _ in range(n):
            self.now_ns += SECOND // 2
            self.count += 1
            mono = self.now_ns - self.start_ns
            common = {"sent_mono_ns": mono, "last_mono_ns": mono, "sent_utc_ns": self.now_ns, "status": "ok"}
            cell = {"rsrp_dbm": rsrp, "sinr_db": 12}
            self.feed.put(modem, {"kind": "exchange", "query": "servingcell", "decoded": {"nr": cell}} | common)
            self.feed.put(modem, {"kind": "exchange", "query": "nr5g_csi", "decoded": {"rank": rank}} | common)
            if predicted is not None:
                record = {"kind": "prediction", "for_sent_utc_ns": self.now_ns, "measured": rank, "predicted": predicted,
                          "rank_interval": [2, 4], "level_dbm": -50.0, "offset_db": -42.0, "rsrp_dbm": rsrp,
                          "level_interval_dbm": [-96.0, -88.0], "inside": [9, 10, 17, 20], "fix": 3.0, "telemetry_age_s": 0.2,
                          "east_m": float(self.count) * 4, "north_m": 20.0, "up_m": 80.0}  # fmt: skip
                self.feed.put(modem, record | fields)

    def status(self, modem=0, **values):
        usual = {"connected": True, "rank": 2, "rsrp_dbm": -90, "sinr_db": 12, "ri_rate_hz": 2.0, "gaps": 0,
                 "records": 5, "bytes_written": 9, "disk_free_bytes": 50 * 2**30, "predicts": True}  # fmt: skip
        self.feed.put(modem, TapStatus(**(usual | values)))

    def record(self, modem=0, **record):
        self.feed.put(modem, {"mono_ns": self.now_ns - self.start_ns} | record)


@pytest.fixture(scope="module")
def driver():
    browser = start("--window-size=1440,1000", "--autoplay-policy=no-user-gesture-required")
    yield browser
    browser.quit()


@pytest.fixture
def fly(driver):
    """Makes a flight and opens its page."""
    running = []

    def make(*arguments, **options):
        flight = Flight(*arguments, **options)
        flight.server.__enter__()
        running.append(flight)
        driver.get(flight.server.urls[0])
        until(driver, "window.live && live.state.modems.length > 0")
        return flight

    yield make
    said = [
        entry for entry in complaints(driver) if "ERR_" not in entry["message"]
    ]  # a server that ends is not an error
    driver.get("about:blank")
    for flight in running:
        flight.server.__exit__()
    assert not said


def until(driver, expression, timeout=15):
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(driver, timeout, 0.05).until(lambda d: d.execute_script(f"return Boolean({expression})"), expression)


def text(driver, element):
    return driver.execute_script(f"return document.getElementById('{element}').textContent")


def choose(driver, element, value):
    script = (
        "const e = document.getElementById(arguments[0]); e.value = arguments[1]; e.dispatchEvent(new Event('change'))"
    )
    driver.execute_script(script, element, value)


def flown(driver, fly, poses, **options):
    """A flight over the made-up map that the page shows."""
    flight = fly(background=made_map())
    flight.fly(poses, **options)
    until(driver, f"live.state.modems[0].rows.columns.t.length === {poses}")
    return flight


def rows(driver, modem=0):
    return driver.execute_script(f"return live.state.modems[{modem}].rows.columns.t.length")


def pixel(driver, element, x, y):
    frame(driver)
    script = """const c = document.getElementById(arguments[0]), k = devicePixelRatio || 1;
    return Array.from(c.getContext('2d').getImageData(arguments[1] * k, arguments[2] * k, 1, 1).data)"""
    return driver.execute_script(script, element, x, y)


def test_measured_and_predicted_stand_beside_each_other(driver, fly):
    flight = fly(background=made_map())
    flight.fly(30)
    flight.fly(1, rank=1, rsrp=-99.0)
    until(driver, "live.state.modems[0].rows.columns.t.length === 31")
    frame(driver)
    card = text(driver, "modems")
    for words in ("Predicted rank3 (2–4)outside", "−7.0 dBoutside", "RSRP−99 dBm", "SINR12 dB"):
        assert words in card
    assert text(driver, "rank-words").endswith("inside the 90 % interval: 90 % of 10")
    assert text(driver, "rsrp-words").endswith("inside the 90 % interval: 85 % of 20")
    assert driver.execute_script("return document.querySelector('#modems .big').textContent") == "1"
    assert "<b>made up</b>" in text(driver, "modems") + driver.find_element("tag name", "h1").text
    flight.fly(1, rank=2, rsrp=-91.0)
    until(
        driver,
        "document.getElementById('modems').textContent.includes('+') || live.state.modems[0].rows.columns.t.length === 32",
    )
    frame(driver)
    assert text(driver, "modems").count("inside") == 2


def test_the_map_shows_the_flight_over_the_prediction_and_is_linked(driver, fly):
    flight = fly(background=made_map())
    flight.fly(20)
    until(driver, "live.poses().length === 20")
    x, y, t = driver.execute_script("return live.poses()[5]")
    assert (
        pixel(driver, "map", x, y)[:3] == [31, 111, 168]
        or driver.execute_script("return document.documentElement.dataset.theme") == "dark"
    )
    below = pixel(driver, "map", x, y + 40)
    choose(driver, "layer", "none")
    assert pixel(driver, "map", x, y + 40) != below  # what was under it came from the prediction
    assert "at 90 m" not in text(driver, "map-words")
    choose(driver, "layer", "level")
    frame(driver)
    assert "level predicted for tower" in text(driver, "map-words")
    assert "at 90 m" in text(driver, "map-words")  # of 30 and 90 m, the height nearer to the UAV at 80 m
    # a pose under the pointer is marked in the charts, and named
    driver.execute_script("""const c = document.getElementById('map'), r = c.getBoundingClientRect();
        c.dispatchEvent(new PointerEvent('pointermove', {clientX: r.left + arguments[0], clientY: r.top + arguments[1], pointerId: 9, bubbles: true}))""", x, y)  # fmt: skip
    frame(driver)
    assert driver.execute_script("return live.state.pose") == t
    assert "24, 20, 80 m" in text(driver, "pose")
    x, y, t = driver.execute_script("return live.poses()[5]")  # a longer line below the map moves it
    before = pixel(driver, "map", x, y)
    choose(driver, "colour", "residual-rsrp")
    assert pixel(driver, "map", x, y) != before
    driver.execute_script("document.getElementById('closer').click()")
    frame(driver)
    assert driver.execute_script("return live.view.zoom") > 1
    table = saves_every_chart(driver)["map.csv"].splitlines()
    assert (len(table), table[0].split(",")[-3:]) == (21, ["east", "north", "up"])


def test_without_predictions_the_page_shows_what_was_measured(driver, fly):
    flight = fly()
    flight.fly(12, predicted=None)
    until(driver, "live.state.modems[0].rows.columns.t.length === 12")
    frame(driver)
    assert driver.find_elements("id", "map") == []
    assert "RSRP−90 dBm" in text(driver, "modems")
    assert "Predicted" not in text(driver, "modems")
    assert text(driver, "rank-words") == "dots measured"


def test_an_old_rank_is_marked_as_old(driver, fly):
    flight = fly()
    flight.fly(4, predicted=None)
    until(driver, "document.querySelector('.big')?.textContent === '2'")
    flight.now_ns += 20 * SECOND  # only statuses come, because the modem is silent
    flight.status()
    until(driver, "document.querySelector('.card.stale .big.none')?.textContent.startsWith('2\\n2')")
    assert re.fullmatch(r"2\n2\d s old", driver.find_element("class name", "big").text)
    flight.fly(predicted=None)
    until(driver, "document.querySelector('.card:not(.stale) .big')?.textContent === '2'")


def test_two_modems_at_once(driver, fly):
    flight = fly(("left", "right"), background=made_map())
    for _ in range(5):
        flight.fly(modem=0, rank=1)
        flight.fly(modem=1, rank=4)
    flight.fly(3, modem=1, rank=4)
    until(driver, "live.state.modems[1]?.rows.columns.t.length === 8")
    frame(driver)
    cards = driver.find_elements("css selector", "#modems .card")
    assert [card.find_element("css selector", ".big").text for card in cards] == ["1", "4"]
    assert rows(driver, 0) == 5
    until(driver, "live.poses().length === 5")
    cards[1].click()
    until(driver, "live.poses().length === 8")
    assert cards[1].get_attribute("aria-pressed") == "true"


def test_alarms_are_shown_kept_and_heard(driver, fly):
    flight = fly(background=made_map())
    flight.fly(3)
    flight.status()
    until(driver, "live.state.modems[0].now.disk_free_bytes")
    assert text(driver, "alarms") == ""
    flight.record(kind="gap", state="open", reason="hung up")
    until(driver, "document.getElementById('alarms').textContent.includes('no modem: hung up')")
    assert driver.execute_script("return live.state.beeps") == 0  # sound was not switched on
    assert text(driver, "state") == "no modem"
    driver.find_element("id", "sound").click()
    assert text(driver, "sound") == "Sound on"
    beeps = driver.execute_script("return live.state.beeps")
    flight.record(kind="gap", state="closed", reason="hung up")
    until(driver, "document.getElementById('alarms').textContent === ''")
    flight.status(disk_free_bytes=2**20, message="the disk fills")
    until(driver, "document.getElementById('alarms').textContent.includes('200 MiB')")
    until(driver, f"live.state.beeps === {beeps + 1}")
    flight.status(disk_free_bytes=50 * 2**30)
    flight.fly(1)
    flight.record(kind="clock", step_ns=2 * SECOND)
    until(driver, "document.getElementById('alarms').textContent.includes('stepped by +2.000 s')")
    flight.fly(1)
    flight.now_ns += 12 * SECOND
    until(driver, "document.getElementById('alarms').textContent.includes('no rank for more than 3 s')")
    until(driver, "document.getElementById('alarms').textContent.includes('no position for more than 5 s')")
    history = [row.text for row in driver.find_elements("css selector", "#history tr")]
    for words in ("hung up", "200 MiB", "the disk fills", "stepped", "no rank", "no position"):
        assert sum(words in line for line in history) == 1, history
    driver.refresh()  # the history is the tap's, not the browser's
    until(driver, "window.live && document.querySelectorAll('#history tr').length === 6")


def test_it_comes_back_by_itself_and_refills(driver, fly):
    flight = flown(driver, fly, 6)
    driver.execute_script("live.drop()")  # the connection is gone
    flight.fly(7)
    until(driver, "live.state.modems[0].rows.columns.t.length === 13")
    times = driver.execute_script("return live.state.modems[0].rows.columns.t")
    assert np.allclose(np.diff(times), 500.0, atol=1.0)  # none missing, none twice
    until(driver, "live.poses().length === 13")


def browsers_of(driver):
    """Return the processes of the browser: the descendants of chromedriver."""
    parents = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    processes = [driver.service.process.pid]
    for pid in processes:
        processes += [child for child, parent in parents.items() if parent == pid]
    return processes[1:]


def test_a_browser_that_is_stopped_misses_nothing(driver, fly):
    flight = flown(driver, fly, 6)
    stopped = browsers_of(driver)
    assert stopped
    try:
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        for _ in range(20):
            flight.fly(50)
            time.sleep(0.1)
    finally:
        for pid in stopped:
            os.kill(pid, signal.SIGCONT)
    until(driver, "live.state.modems[0].rows.columns.t.length === 1006")
    times = driver.execute_script("return live.state.modems[0].rows.columns.t")
    assert np.allclose(np.diff(times), 500.0, atol=1.0)


def test_a_tap_that_is_started_anew_goes_on_in_the_same_page(driver, fly):
    flight = flown(driver, fly, 6)
    port = flight.server.address.port
    driver.execute_script("window.same = true")
    flight.server.__exit__()
    until(driver, "document.getElementById('state').textContent === 'no connection to the tap'")
    again = Flight(background=made_map(), port=port, token=flight.server.token)
    again.now_ns = again.start_ns = again.feed.start_ns = flight.now_ns + 20 * SECOND
    with again.server:
        again.fly(4)
        until(driver, "live.state.modems[0].rows.columns.rank.filter(Number.isFinite).length === 10")
        assert driver.execute_script("return window.same")
        driver.get("about:blank")


def test_the_end_is_said_and_the_report_offered(driver, fly):
    flight = fly(background=made_map())
    flight.fly(5)
    flight.record(kind="end", reason="SIGINT")
    flight.feed.end({"text": "The tap ended at 10:00:00 UTC (SIGINT).",
                     "commands": ["aerpaw-cmp ingest log --draft flight.yaml", "aerpaw-cmp report flight.yaml"]})  # fmt: skip
    until(driver, "!document.getElementById('ended').hidden")
    assert text(driver, "state") == "ended"
    assert not driver.find_element("id", "commands").is_displayed()
    driver.find_element("id", "show-report").click()
    assert driver.find_element("id", "commands").text.endswith("aerpaw-cmp report flight.yaml")
    assert text(driver, "alarms") == ""


def test_themes_widths_and_keyboard(driver, fly):
    flight = fly(background=made_map())
    flight.fly(30)
    flight.status(message="a message")
    until(driver, "live.poses().length === 30")
    papers = []
    for _ in range(2):
        driver.execute_script("document.getElementById('theme').click()")
        papers.append(pixel(driver, "chart-rank", 1, 1)[:3])
        assert serious_findings(driver) == {}
    assert sorted(map(sum, papers))[0] < 100 < 700 < sorted(map(sum, papers))[1]
    chosen = driver.execute_script("return document.documentElement.dataset.theme")
    driver.refresh()
    until(driver, "window.live")
    assert driver.execute_script("return document.documentElement.dataset.theme") == chosen
    for width in (1440, 768, 390):
        page, rights = extents(driver, width, "canvas, button, select, section")
        assert page <= width
        assert max(rights) <= width
    set_scheme(driver)


def test_nothing_is_asked_of_another_place(driver, fly):
    import json

    driver.get_log("performance")
    flight = flown(driver, fly, 3)
    messages = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    asked = {
        m["params"]["request"]["url"].partition("?")[0] for m in messages if m["method"] == "Network.requestWillBeSent"
    }
    own = flight.server.urls[0].partition("?")[0]
    private = own + flight.server.base[1:]
    asked = {url for url in asked if not url.startswith(("data:", "about:", "chrome:"))}
    assert asked == {own, private, private + "events"}


def test_the_demo_of_the_readme(driver, tmp_path, capsys):
    """Run the commands that a reader types: modem-sim, tap --web, Ctrl-C. Then replay the log to the page."""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'parsers'}"}

    def run(*arguments):
        command = [sys.executable, "-m", "aerpaw_cmp", *map(str, arguments)]
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT
        )

    def page_of(process):
        line = ""
        while "the page: " not in line:
            line = process.stderr.readline()
            assert line, process.communicate()
        return line.split()[2]

    flight, telemetry, log = "sample_logs/flight.yaml", tmp_path / "vehicleOut.txt", tmp_path / "taplog"
    sim = run("modem-sim", "--link", tmp_path / "modem", "--flight", flight, "--telemetry", telemetry)
    try:
        sim.stdout.readline()
        options = ("--flight", flight, "--telemetry", telemetry, "--web", "127.0.0.1:0", "--no-status")
        tapped = run("tap", tmp_path / "modem", "-o", log, *options)
        driver.get(page_of(tapped))
        until(
            driver, "live.poses().length > 8 && live.state.modems[0].predictions.columns.predicted.some(v => v > 0)", 40
        )
        assert not driver.find_element("id", "ended").is_displayed()
        tapped.send_signal(signal.SIGINT)
        _out, err = tapped.communicate(timeout=20)
        assert tapped.returncode == 0, err
        until(driver, "!document.getElementById('ended').hidden")
        assert "SIGINT" in text(driver, "ended-text")
        shown = ["ingest", str(log), str(telemetry), "--timezone", "America/New_York", "--draft", "flight.yaml"]
        assert shlex.split(text(driver, "commands").splitlines()[0]) == ["aerpaw-cmp", *shown]
        assert [path.suffix for path in log.iterdir()] == [".jsonl"]
        ingested = ["ingest", log, telemetry, "--timezone", "America/New_York", "--draft", tmp_path / "flight.yaml"]
        assert main([*map(str, ingested)]) == 0
        out, err = capsys.readouterr()
        assert "rank: nr5g" in out
        assert "rows are missing" not in out + err
        assert (tmp_path / "flight.yaml").exists()
    finally:
        sim.send_signal(signal.SIGINT)
        sim.communicate(timeout=20)
        driver.get("about:blank")
