"""The tap's page without a browser: what the server answers and refuses, what the feed keeps."""

import base64
import contextlib
import http.client
import json
import math
import random
import re
import socket
import threading
import time

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.live.feed import CHUNK, MEASURED, Feed, Rows
from aerpaw_cmp.live.ports import TapStatus, stale_after_s
from aerpaw_cmp.live.predict import RunningInterval
from aerpaw_cmp.live.web import Address, Limits, WebServer
from tests.live.terminals import until
from tests.long.tap_common import damaged

SECOND = 1_000_000_000
MANY = Limits(connections=200)


class Hand:
    """A feed whose clock is turned by hand, and records for it."""

    def __init__(self, names=("modem",), rate_ns=SECOND // 2):
        self.now_ns = self.start_ns = 1_000 * SECOND
        self.step = rate_ns
        self.feed = Feed(list(names), lambda: self.mono_ns, lambda: self.now_ns)
        for modem in range(len(names)):
            self.put({"kind": "header", "utc_ns": self.now_ns, "mono_ns": 0, "port": {}}, modem)

    @property
    def mono_ns(self):
        return self.now_ns - self.start_ns

    def put(self, record, modem=0):
        self.feed.put(modem, record)
        self.feed.digest()

    def answer(self, rank=2, modem=0, query="nr5g_csi", utc_ns=0, **decoded):
        self.now_ns += self.step
        times = {f"{end}_{clock}_ns": self.mono_ns for end in ("sent", "last") for clock in ("mono",)}
        sent = utc_ns or self.now_ns
        record = {"kind": "exchange", "query": query, "status": "ok", "decoded": {"rank": rank} | decoded}
        self.put(record | times | {"sent_utc_ns": sent, "last_utc_ns": sent}, modem)
        return sent

    def predict(self, sent, **fields):
        self.put({"kind": "prediction", "for_sent_utc_ns": sent, "measured": 2, "predicted": 3} | fields)

    def status(self, **values):
        usual = dict.fromkeys(("rank", "rsrp_dbm", "sinr_db"))
        usual |= {"connected": True, "ri_rate_hz": 2.0, "gaps": 0, "records": 5, "bytes_written": 9}
        self.put(TapStatus(**(usual | {"disk_free_bytes": 2**40} | values)))

    def open(self):
        return sorted(a["kind"] for a in self.feed.after("")[0]["alarms"] if a["end_s"] is None)


def rows_of(message, modem=0, key="rows"):
    raw = base64.b64decode(message["modems"][modem][key][1])
    return np.frombuffer(raw, "<f4").reshape(-1, len(MEASURED) if key == "rows" else 12)


@pytest.fixture
def server(tools):
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), token="benchmark", limits=MANY) as web:
        yield web


def cookie_of(web):
    return f"aerpaw_tap_{web.address.port}={web.pass_word}"


def ask(web, path="/", method="GET", host="127.0.0.1", **headers):
    """Answer to a browser that was there before, unless its cookie is given."""
    headers.setdefault("Cookie", cookie_of(web))
    # the cookie counts below the path that it is bound to
    path = path if headers["Cookie"] is None else web.base + path.removeprefix("/")
    link = http.client.HTTPConnection("127.0.0.1", web.address.port, timeout=5)
    link.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in {"Host": host, **{k.replace("_", "-"): v for k, v in headers.items()}}.items():
        if value is not None:
            link.putheader(name, value)
    link.endheaders()
    answer = link.getresponse()
    body = b"" if answer.status == 200 and "/events" in path else answer.read()
    parts = answer.status, dict(answer.getheaders()), body
    link.close()
    return parts


# the server ----------------------------------------------------------------------------------------------------


def test_one_page_with_a_strict_policy(server, tools):
    status, headers, body = ask(server)
    assert (status, body) == (200, tools.page.body)
    assert headers["Content-Security-Policy"] == tools.page.policy
    assert (headers["X-Content-Type-Options"], headers["Cache-Control"]) == ("nosniff", "no-store")
    status, headers, _ = ask(server, "/events")
    assert (status, headers["Content-Type"]) == (200, "text/event-stream")


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/live.js", "/index.html", "/events/", "/favicon.ico", "//etc/passwd", "/./"],
)  # fmt: skip
def test_no_other_file(server, path):
    status, _, body = ask(server, path)
    assert (status, body) == (404, b"there is one page here: /\n")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "HEAD", "TRACE", "<b>"])
def test_no_other_method(server, method):
    status, headers, body = ask(server, method=method)
    assert status in (400, 501)
    assert method.encode() not in body
    assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    ("host", "headers", "status"),
    [
        ("localhost:9000", {}, 200),  # a tunnel's port
        ("[::1]:8765", {}, 200),
        ("evil.example", {}, 403),  # DNS rebinding: the name leads here, the site is another
        ("evil.example:8765", {}, 403),
        ("192.168.7.9", {}, 403),  # not an address of the loopback
        ("127.0.0.1.evil.example", {}, 403),
        ("", {}, 403),
        (None, {}, 403),
        ("127.0.0.1", {"Origin": "http://evil.example"}, 403),
        ("127.0.0.1", {"Origin": "null"}, 403),
        ("127.0.0.1:80", {"Origin": "http://127.0.0.1:81"}, 403),
        ("127.0.0.1:80", {"Origin": "http://127.0.0.1:80"}, 200),
        ("127.0.0.1", {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Dest": "iframe"}, 403),
        ("127.0.0.1", {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Dest": "document"}, 200),  # a link was followed
        ("127.0.0.1", {"Sec_Fetch_Site": "same-origin", "Sec_Fetch_Dest": "empty"}, 200),
    ],
)
def test_host_and_origin(server, host, headers, status):
    assert ask(server, host=host, **headers)[0] == status
    dest = headers.get("Sec_Fetch_Dest") == "document"
    assert ask(server, "/events", host=host, **headers)[0] == (403 if dest else status)


def test_two_hosts_are_none(server):
    with socket.create_connection(("127.0.0.1", server.address.port), 5) as link:
        link.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n")
        assert b" 403 " in link.makefile("rb").readline()


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_token_is_wanted_everywhere(host, tools):
    with WebServer(Feed(["modem"]), tools.page, Address(host, 0), limits=MANY) as web:
        (query,) = {url.partition("?")[2] for url in web.urls}
        assert len(query) > len("token=") + 15
        for path in ("/", "/events", "/other"):
            for wrong in ("", "?token=", "?token=wrong", f"?{query}x", f"?{query.upper()}", "?token=%ff%00"):
                assert ask(web, path + wrong, Cookie=None)[0] == 403
            for wrong in (
                "",
                "a=b",
                cookie_of(web)[:-1],
                f"x{cookie_of(web)}",
                cookie_of(web).replace("_", "-"),
                "=;;=",
            ):
                assert ask(web, path, Cookie=wrong)[0] == 403
        for path, status in (("/", 303), (web.base, 200), ("/events", 200), ("/other", 404)):
            assert ask(web, f"{path}?{query}", Cookie=None)[0] == status
        # a name that is not ours may have been rebound; an address cannot be
        assert ask(web, f"/?{query}", host="evil.example")[0] == 403
        assert ask(web, f"/?{query}", host="192.168.7.9:1")[0] == (403 if host == "127.0.0.1" else 200)
        assert ask(web, f"/?{query}", host=socket.gethostname())[0] == (403 if host == "127.0.0.1" else 200)


def test_the_first_visit_gives_a_cookie_that_scripts_and_other_sites_never_see(tools):
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), limits=MANY) as web:
        status, headers, _ = ask(web, f"/?token={web.token}", Cookie=None)
        assert (status, headers["Location"]) == (303, f"{web.base}?token={web.token}")
        assert "Set-Cookie" not in headers
        status, headers, body = ask(web, headers["Location"], Cookie=None)
        cookie, *marks = headers["Set-Cookie"].split("; ")
        assert (status, sorted(marks)) == (200, ["HttpOnly", f"Path={web.base}", "SameSite=Strict"])
        assert re.fullmatch("/[0-9a-f]{32}/", web.base), "no server of another port can guess the path"
        assert web.base.encode() not in body
        assert headers["Referrer-Policy"] == "no-referrer"
        assert web.token not in cookie
        assert web.token.encode() not in body
        assert ask(web, "/", Cookie=f"other=1; {cookie}")[0] == 200
        assert ask(web, "/events", Cookie=cookie)[0] == 200
        link = http.client.HTTPConnection("127.0.0.1", web.address.port, timeout=5)
        for path in ("/", "/events", web.base[:-2] + "x/"):
            link.request("GET", path, headers={"Cookie": cookie})
            assert link.getresponse().status == 403, "the cookie counts nowhere else"
            link.close()


def test_a_token_that_was_set_is_not_printed(tools):
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), token="of the unit") as web:
        assert ask(web, f"{web.base}?token=of%20the%20unit", Cookie=None)[0] == 200
        assert not [url for url in web.urls if "unit" in url]


def test_a_flood_of_an_address_keeps_neither_others_out_nor_who_has_the_token(tools):
    """One address asks without the token, and fills all places in which connections wait."""
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), limits=Limits(connections=4)) as web:

        def answer(source, text):
            with socket.create_connection(("127.0.0.1", web.address.port), 10, (source, 0)) as link:
                link.sendall(f"GET {text} HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n".encode())
                with contextlib.suppress(ConnectionResetError):
                    return link.makefile("rb").readline()[9:12].decode()
                return ""

        hostile = [answer("127.0.0.2", "/?x") for _ in range(40)]
        assert hostile == ["403"] * 40
        places = ("127.0.0.1", web.address.port)
        silent = [socket.create_connection(places, 10, ("127.0.0.2", 0)) for _ in range(300)]
        until(lambda: len(web.waiting) == 256, 10.0)
        for source in ("127.0.0.3", "127.0.0.2"):
            assert answer(source, f"{web.base}?token={web.token}") == "200"
        assert answer("127.0.0.3", "/?x") == "403"
        for link in silent:
            link.close()


def test_browsers_with_the_token_are_bounded(tools):
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), limits=Limits(connections=2)) as web:
        browsers = [tools.Browser.of(web) for _ in range(2)]
        until(lambda: len(web.browsers) == 2, 10.0)
        assert ask(web)[0] == 503
        for browser in browsers:
            browser.close()
        until(lambda: ask(web)[0] == 200, 10.0)


def test_a_taken_port_is_refused(tools):
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        with pytest.raises(UsageError, match=f"--web 127.0.0.1:{port}: .*a free port.*another tap or another server"):
            WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", port))


@pytest.mark.parametrize("text", ["", "8765", "localhost", "a b:1", "127.0.0.1:70000", "http://127.0.0.1:80", "::1:80"])
def test_addresses_that_are_none(text):
    with pytest.raises(UsageError, match="expected HOST:PORT"):
        Address.parse(text)


def test_an_address_of_another_computer(tools):
    with pytest.raises(UsageError, match="this computer has no such address"):
        WebServer(Feed(["modem"]), tools.page, Address("192.0.2.77", 8765))


def test_damaged_requests_get_the_page_or_nothing(server, tools):
    chance, threads = random.Random(3), threading.active_count()
    kinds = set()
    for _ in range(300):
        head = body = b""
        with socket.create_connection(("127.0.0.1", server.address.port), 5) as link, contextlib.suppress(OSError):
            link.sendall(damaged(chance))
            link.shutdown(socket.SHUT_WR)
            head, _, body = link.makefile("rb").read(500).partition(b"\r\n\r\n")
        kinds.add(head[9:12])
        assert (
            body in (b"", tools.page.body)
            or body.startswith((b"retry: 1000", b"there is one page", b"the "))
            or len(body) < 60
        )
    assert {b"404", b"403"} <= kinds
    until(lambda: threading.active_count() <= threads + 2, 10.0)
    assert ask(server)[0] == 200


def test_a_browser_that_takes_nothing_is_dropped_and_others_miss_nothing(tools):
    feed, sent = Feed(["modem"]), 0
    record = {"kind": "exchange", "query": "nr5g_csi", "status": "ok", "decoded": {"rank": 1}, "sent_utc_ns": 0}
    with WebServer(feed, tools.page, Address("127.0.0.1", 0), limits=Limits(send_s=0.3, tick_s=0.01)) as web:
        stuck, good = tools.Browser.of(web, reads=False), tools.Browser.of(web)
        until = time.monotonic() + 30

        def streams(wanted):
            assert time.monotonic() < until
            time.sleep(0.01)
            return len(web.browsers) == wanted

        while not streams(2):
            pass
        while not streams(1):  # until the buffers between here and there are full
            for _ in range(500):
                feed.put(0, record | {"sent_mono_ns": sent, "last_mono_ns": sent})
                sent += 1
        while good.messages[-1]["modems"][0]["rows"][0] + len(rows_of(good.messages[-1])) < sent:
            assert streams(1)
        assert sum(len(rows_of(message)) for message in good.messages) == sent
        assert good.connections == 1
        for browser in (stuck, good):
            browser.close()


def test_a_flood_of_connections_is_bounded(tools):
    limits = Limits(connections=8, request_s=0.5)
    with WebServer(Feed(["modem"]), tools.page, Address("127.0.0.1", 0), limits=limits) as web:
        threads = threading.active_count()
        links = [socket.create_connection(("127.0.0.1", web.address.port), 5) for _ in range(100)]
        until(lambda: threading.active_count() <= threads + limits.connections, 10.0)
        for link in links[:20]:  # a byte now and then does not hold a place beyond the time for a request
            with contextlib.suppress(OSError):
                link.sendall(b"G")
        until(lambda: threading.active_count() <= threads, 10.0)
        for link in links:
            link.close()
        assert ask(web)[0] == 200  # and others are served again


def test_the_tap_never_waits_for_the_page():
    feed = Feed(["modem"])

    def poll():
        for number in range(50_000):
            feed.put(0, {"kind": "late", "n": number})

    with feed._changed:  # as if a browser's thread stood still while it holds what it reads
        polling = threading.Thread(target=poll, daemon=True)
        polling.start()
        polling.join(timeout=30.0)
        assert not polling.is_alive()
    assert len(feed._pending) == feed._pending.maxlen


# the feed ------------------------------------------------------------------------------------------------------


def test_rows_are_counted_and_the_oldest_go():
    rows = Rows(size=5)
    for number in range(8):
        rows.add((number, None if number == 6 else -number))
    first, data = rows.after(0)
    values = np.frombuffer(base64.b64decode(data), "<f4").reshape(-1, 2)
    assert (first, values[:, 0].tolist()) == (3, [3, 4, 5, 6, 7])
    assert math.isnan(values[3, 1])
    assert rows.after(6)[0] == 6
    assert rows.after(8) == (8, "")
    assert rows.after(99) == (8, "")
    assert len(base64.b64decode(rows.after(0, most=2)[1])) == 2 * 2 * 4


def test_a_browser_that_comes_back_gets_what_it_missed_once():
    hand = Hand()
    for _ in range(5):
        hand.answer()
    message, cursor = hand.feed.after("")
    assert (len(rows_of(message)), message["continues"]) == (5, False)
    assert hand.feed.after(cursor)[0] is None
    for _ in range(3):
        hand.answer(rank=4)
    message, after = hand.feed.after(cursor)
    assert message["continues"]
    assert (message["modems"][0]["rows"][0], rows_of(message)[:, 1].tolist()) == (5, [4, 4, 4])
    for wrong in ("rubbish", cursor.replace("-", "_"), "0" * 8 + cursor[8:], cursor + "-1", "\n", cursor + "9" * 40):
        assert len(rows_of(hand.feed.after(wrong)[0])) == 8
    assert hand.feed.after(after)[0] is None


def test_a_long_flight_comes_in_pieces():
    hand = Hand()
    for _ in range(2 * CHUNK + 10):
        hand.feed.put(0, {"kind": "exchange", "query": "nr5g_csi", "status": "ok", "decoded": {"rank": 1},
                          "sent_mono_ns": 0, "last_mono_ns": 0, "sent_utc_ns": 0})  # fmt: skip
    hand.feed.digest()
    cursor, sizes = "", []
    while (piece := hand.feed.after(cursor))[0] is not None:
        sizes.append(len(rows_of(piece[0])))
        cursor = piece[1]
    assert sizes == [CHUNK, CHUNK, 10]


def test_measurements_and_predictions_stand_in_rows():
    hand = Hand()
    hand.answer(query="servingcell", nr={"rsrp_dbm": -91, "sinr_db": 14})
    sent = hand.answer(rank=2)
    hand.predict(sent, east_m=10.0, north_m=20.0, up_m=40.0, level_dbm=-50.0, offset_db=-40.0, rsrp_dbm=-91,
                 rank_interval=[2, 4], level_interval_dbm=[-95.0, -85.0], inside=[1, 1, 0, 0])  # fmt: skip
    hand.predict(sent + 1)  # a prediction for an unknown answer
    message, _ = hand.feed.after("")
    assert rows_of(message).tolist() == [[1.0, 2.0, -91.0, 14.0]]
    assert rows_of(message, key="predictions").tolist() == [[1.0, 2, 3, 2, 4, -91, -90, -95, -85, 10, 20, 40]]
    shown = message["modems"][0]
    assert (shown["rank"], shown["offset_db"], shown["inside"], shown["predicts"]) == (2, -40.0, [1, 1, 0, 0], True)


def test_two_modems_stand_side_by_side():
    hand = Hand(("left", "right"))
    hand.answer(rank=1, modem=0)
    hand.answer(rank=4, modem=1)
    message, cursor = hand.feed.after("")
    assert [m["name"] for m in message["modems"]] == ["left", "right"]
    assert [rows_of(message, i)[0, 1] for i in (0, 1)] == [1, 4]
    hand.answer(rank=2, modem=1)
    message, _ = hand.feed.after(cursor)
    assert [len(rows_of(message, i)) for i in (0, 1)] == [0, 1]


def test_a_wall_clock_that_jumps_leaves_the_rows_in_order():
    hand = Hand()
    for utc_ns in (5_000 * SECOND, 5_001 * SECOND, 3 * SECOND, 9_000 * SECOND):
        sent = hand.answer(utc_ns=utc_ns)
        hand.predict(sent, east_m=0.0, north_m=0.0, up_m=1.0)
    hand.put({"kind": "clock", "step_ns": -4_998 * SECOND, "mono_ns": hand.mono_ns})
    message, _ = hand.feed.after("")
    for key in ("rows", "predictions"):
        times = rows_of(message, key=key)[:, 0]
        assert times.tolist() == [0.5, 1.0, 1.5, 2.0]
    assert hand.open() == ["step"]
    assert any("-4998.000 s" in alarm["text"] for alarm in message["alarms"])


@pytest.mark.parametrize(
    ("ri_hz", "step_s", "shown"), [(2, 0.056, 0), (10, 0.056, 0), (2, 0.3, 1), (10, -0.25, 1), (0.1, 1.0, 0)]
)
def test_a_step_of_the_clock_is_an_alarm_where_it_moves_a_sample(ri_hz, step_s, shown):
    hand = Hand()
    hand.put({"kind": "header", "utc_ns": hand.now_ns, "mono_ns": 0, "port": {}, "settings": {"ri_hz": ri_hz}})
    hand.answer()
    hand.put({"kind": "clock", "step_ns": int(step_s * SECOND), "mono_ns": hand.mono_ns})
    assert hand.open() == ["step"] * shown


def test_each_alarm_opens_and_closes():
    hand = Hand()
    hand.answer()
    assert hand.open() == []
    for _ in range(9):
        hand.answer(rank=None)
    assert hand.open() == ["stale"]
    hand.answer(rank=1)
    assert hand.open() == []
    hand.put({"kind": "gap", "state": "open", "reason": "pulled", "mono_ns": hand.mono_ns})
    hand.now_ns += int(2 * stale_after_s(0.5) * SECOND)
    hand.feed.digest()
    assert hand.open() == ["gap"]  # and not that the rank is old, too
    hand.put({"kind": "gap", "state": "closed", "reason": "pulled", "mono_ns": hand.mono_ns})
    hand.status(disk_free_bytes=10 * 2**20)
    assert hand.open() == ["disk"]
    hand.status(disk_fault="No space left on device")
    hand.status()
    assert hand.open() == []
    hand.put({"kind": "header", "utc_ns": hand.now_ns, "mono_ns": hand.mono_ns, "clock_synchronised": False})
    hand.answer()
    assert hand.open() == ["clock"]
    message, _ = hand.feed.after("")
    kinds = [(alarm["kind"], alarm["end_s"] is None) for alarm in message["alarms"]]
    assert kinds == [("stale", False), ("gap", False), ("disk", False), ("clock", True)]


def test_a_rank_that_is_asked_for_slowly_is_not_stale_for_it():
    hand = Hand(rate_ns=10 * SECOND)
    hand.put({"kind": "header", "utc_ns": hand.now_ns, "mono_ns": 0, "port": {}, "settings": {"ri_hz": 0.1}})
    for _ in range(4):
        hand.answer()
    assert hand.open() == []
    for _ in range(4):
        hand.answer(rank=None)
    assert hand.open() == ["stale"]
    assert "for more than 30 s" in hand.feed.after("")[0]["alarms"][-1]["text"]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"east_m": None, "telemetry_age_s": 9.0}, "the telemetry log is not up to date"),
        ({"east_m": 5.0, "telemetry_age_s": 0.1, "fix": 1.0}, "no 3-D fix"),
        ({"east_m": None, "fix": None}, "has no lines yet"),
    ],
)
def test_gps_lost(fields, words):
    hand = Hand()
    for number in range(30):
        sent = hand.answer()
        hand.predict(sent, **({"east_m": 1.0, "telemetry_age_s": 0.2, "fix": 3.0} if number < 10 else fields))
        assert hand.open() == (["gps"] if number >= 20 else [])
    assert words in hand.feed.after("")[0]["alarms"][-1]["text"]


@pytest.mark.parametrize(("delay_s", "words"), [(3.2, "3.2 s behind"), (-1.4, "1.4 s ahead of"), (0.4, None)])
def test_a_telemetry_clock_that_is_off(delay_s, words):
    hand = Hand()
    hand.predict(hand.answer(), east_m=1.0, telemetry_delay_s=delay_s)
    texts = [alarm["text"] for alarm in hand.feed.after("")[0]["alarms"]]
    assert [words in text for text in texts] == ([True] if words else [])


def test_old_values_are_not_shown_as_present_ones():
    hand = Hand()
    hand.answer(query="servingcell", nr={"rsrp_dbm": -91, "sinr_db": 14})
    for _ in range(12):
        hand.answer()
    levels = rows_of(hand.feed.after("")[0])[:, 2]
    assert levels[:6].tolist() == [-91.0] * 6  # six answers are 3 s
    assert np.isnan(levels[6:]).all()
    hand.now_ns += 7 * SECOND
    shown = hand.feed.after("")[0]["modems"][0]
    assert (shown["rank"], shown["rank_age_s"], shown["stale_s"]) == (2, 7.0, 3.0)
    assert shown["rsrp_dbm"] is None


def test_crafted_records_of_a_log_are_left_out():
    hand = Hand()
    for record in (
        {"kind": "exchange"},
        {"kind": "exchange", "query": "nr5g_csi", "decoded": 7, "sent_mono_ns": 1, "last_mono_ns": 1},
        {"kind": "exchange", "query": "nr5g_csi", "decoded": {"rank": "<b>"}, "sent_mono_ns": 1, "last_mono_ns": 1, "status": "ok", "sent_utc_ns": 1},
        {"kind": "gap"},
        {"kind": "clock", "mono_ns": "x"},
        {"kind": "prediction", "for_sent_utc_ns": []},
        {"kind": ["header"]},
        {"kind": "header", "utc_ns": hand.now_ns, "mono_ns": 0, "port": {}, "settings": {"ri_hz": 0}},
        {},
    ):  # fmt: skip
        hand.put(record)
    hand.answer(query="servingcell", nr={"rsrp_dbm": math.nan, "sinr_db": "12"})
    hand.predict(hand.answer(rank=3), offset_db=math.inf, telemetry_delay_s="late", level_dbm=1.0, inside=[math.nan])
    hand.predict(hand.answer(rank=3), offset_db=math.inf, telemetry_delay_s="late", level_dbm=1.0)
    message = hand.feed.after("")[0]
    json.dumps(message, allow_nan=False)
    assert (message["modems"][0]["rsrp_dbm"], message["modems"][0]["offset_db"]) == (None, None)
    hand.answer(rank=3)
    assert rows_of(hand.feed.after("")[0])[-1, 1] == 3


def test_the_end_is_said_to_all():
    hand = Hand()
    hand.answer()
    _, cursor = hand.feed.after("")
    assert hand.feed.after("")[0]["modems"][0]["rank"] == 2
    hand.put({"kind": "end", "mono_ns": hand.mono_ns})
    assert hand.feed.after("")[0]["modems"][0]["rank"] is None
    hand.feed.end({"text": "over", "commands": ["a"]})
    assert hand.feed.after(cursor)[0]["ended"]["text"] == "over"


# intervals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phi", [0.0, 0.9, 0.98])
def test_the_running_interval_holds_what_it_says(phi):
    """Residuals that remember each other, about an unknown offset: nine of ten lie inside, in the long run."""
    shares = []
    for seed in range(20):
        noise, interval, value = np.random.default_rng(seed), RunningInterval(), 0.0
        for _ in range(3000):
            value = phi * value + 4.0 * math.sqrt(1 - phi**2) * noise.standard_normal()
            interval.add(-40.0 + value)
        assert interval.given > 2000
        shares.append(interval.inside / interval.given)
    assert 0.88 < np.mean(shares) < 0.92
    assert min(shares) > 0.85
    assert max(shares) < 0.95


def test_no_interval_before_there_is_anything_to_judge_by():
    interval = RunningInterval()
    for number in range(20):
        assert interval.bounds() is None
        interval.add(float(number))
    assert interval.bounds() is not None


# the tap with a page -------------------------------------------------------------------------------------------


def test_the_log_is_as_without_the_page(modem, tap, tools, tmp_path):
    logs = []
    for name in ("with", "without"):
        sim = modem(link=tmp_path / name)
        with tools.page_open(name == "with") as feed:
            options = {} if feed is None else {"watch": lambda item, feed=feed: feed.put(0, item)}
            session = tap(sim.port, folder=tmp_path / f"log-{name}", options=options)
            session.wait(lambda sim=sim: len(sim.journal) > 60)
            session.end()
        records, bad = tools.records_of(tmp_path / f"log-{name}")
        assert not bad
        assert [record["n"] for record in records] == list(range(len(records)))
        logs.append({(record["kind"], tuple(record)) for record in records})
        (file,) = (tmp_path / f"log-{name}").iterdir()
        assert file.name.startswith("tap_")
    assert logs[0] == logs[1]


def test_the_page_gets_every_answer_of_the_log(modem, tap, tools, tmp_path):
    sim, feed = modem(), Feed(["modem"])
    with WebServer(feed, tools.page, Address("127.0.0.1", 0)) as web:
        browser = tools.Browser.of(web)
        session = tap(sim.port, options={"watch": lambda item: feed.put(0, item)})
        session.wait(lambda: len(sim.journal) > 80)
        session.end()
    browser.close()
    logged = [r["decoded"]["rank"] for r in tools.exchanges(tmp_path / "log", "nr5g_csi")]
    shown, count = [], 0
    for message in browser.messages:
        first = message["modems"][0]["rows"][0]
        assert first == count
        rows = rows_of(message)
        count += len(rows)
        shown += rows[:, 1].tolist()
    assert shown == logged
