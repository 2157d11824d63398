"""Framing: the same events however the bytes are cut, a bounded buffer, nothing lost."""

import pickle
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.live.modem import Framer, Late, Unsolicited, unglue

CSI = ('AT+QNWCFG="nr5g_csi"', ('+QNWCFG:"nr5g_csi"',))
QENG = ('AT+QENG="servingcell"', ("+QENG:",))


def every_cut(data, feed_all):
    uncut = feed_all([data])
    assert feed_all([data[i : i + 1] for i in range(len(data))]) == uncut
    for cut in range(len(data) + 1):
        assert feed_all([data[:cut], data[cut:]]) == uncut, f"cut at byte {cut}"
    return uncut


def sent(*commands):
    """A framer of commands of which all but the last were given up."""
    framer = Framer()
    for number, command in enumerate(commands):
        if number:
            framer.give_up()
        framer.send(*command)
    return framer


def live(pieces, command=CSI):
    framer = sent(command)
    return [event for piece in pieces for event in framer.feed(piece)]


@pytest.mark.parametrize(
    "echo", [b"", b'AT+QNWCFG="nr5g_csi"\r\r\n', b'at+qnwcfg="nr5g_csi"\r\n', b'\x80\x81AT+QNWCFG="nr5g_csi"\r']
)
@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r", b"\r\r\n", b"\n\r\n\n"])
@pytest.mark.parametrize("final", [("OK", "ok", None), ("+CME ERROR: 14", "cme", "14"), ("ERROR", "error", None)])
def test_live_answer_at_every_cut(echo, end, final):
    text, status, code = final
    data = echo + end + b'+QNWCFG: "nr5g_csi",13,2,8,896' + end + b'+CEREG: 1,"1F"' + end + text.encode() + end
    events = every_cut(data, live)
    assert events[0] == Unsolicited('+CEREG: 1,"1F"')
    assert events[1].lines == ('+QNWCFG: "nr5g_csi",13,2,8,896',)
    assert (events[1].status, events[1].code) == (status, code)
    assert any(flag.startswith("echo") for flag in events[1].flags) == bool(echo)


def test_answer_of_another_query_is_not_taken():
    events = live([b'+QNWCFG: "lte_csi",1,1,1,1\r\n+QNWCFG: "nr5g_csi",2,2,2,2\r\nOK\r\n'])
    assert events[0] == Unsolicited('+QNWCFG: "lte_csi",1,1,1,1')
    assert events[1].lines == ('+QNWCFG: "nr5g_csi",2,2,2,2',)


def test_ok_glued_to_the_last_field():
    assert live([b'+QNWCFG: "nr5g_csi",2,2,2,2OK\r\n'])[0].status == "ok"
    assert unglue('+QSPN: "X+CREG: 1",2') == ('+QSPN: "X+CREG: 1",2',)
    assert unglue('+QSPN: "TOKYO') == ('+QSPN: "TOKYO',)


def test_late_answer_is_kept_and_not_taken_for_the_next():
    framer = sent(CSI)
    framer.feed(b'\r\n+QNWCFG: "nr5g')
    answer = framer.give_up()
    assert (answer.status, answer.partial) == ("timeout", '+QNWCFG: "nr5g')
    framer.send(*QENG)
    events = framer.feed(b'_csi",13,2,8,896\r\n\r\nOK\r\n\r\n+QENG: "servingcell","SEARCH"\r\n\r\nOK\r\n')
    assert events[0] == Late(('+QNWCFG: "nr5g_csi",13,2,8,896',), "ok")
    assert events[1].lines == ('+QENG: "servingcell","SEARCH"',)


def test_late_answer_to_the_same_query_is_told_by_the_echo():
    framer, echo = sent(CSI), b'AT+QNWCFG="nr5g_csi"\r\r\n'
    framer.feed(echo)
    framer.give_up()
    framer.send(*CSI)
    late = b'+QNWCFG: "nr5g_csi",1,1,1,1\r\n\r\nOK\r\n'
    events = framer.feed(late + echo + b'+QNWCFG: "nr5g_csi",2,2,2,2\r\nOK\r\n')
    assert isinstance(events[0], Late)
    assert events[-1].lines == ('+QNWCFG: "nr5g_csi",2,2,2,2',)


def test_late_answer_with_nothing_in_flight():
    framer = sent(CSI)
    framer.give_up()
    assert framer.feed(b'+QNWCFG: "nr5g_csi",1,1,1,1\r\nOK\r\n') == [Late(('+QNWCFG: "nr5g_csi",1,1,1,1',), "ok")]


def test_bare_ok_of_a_late_answer_does_not_end_the_next():
    events = sent(CSI, QENG).feed(b'OK\r\n+QENG: "servingcell","SEARCH"\r\nOK\r\n')
    assert events[0] == Late((), "ok")
    assert events[1].lines == ('+QENG: "servingcell","SEARCH"',)


def test_ten_megabytes_without_line_end_stay_bounded():
    framer = sent(CSI)
    for _ in range(160):
        assert framer.feed(b"x" * 65_536) == []
        assert len(pickle.dumps(framer)) < 70_000
    events = framer.feed(b'\r\n+QNWCFG: "nr5g_csi",13,2,8,896\r\nOK\r\n')
    assert isinstance(events[0], Unsolicited)
    assert len(events[0].text) + events[0].dropped == 160 * 65_536
    assert events[1].lines == ('+QNWCFG: "nr5g_csi",13,2,8,896',)


def test_endless_answer_stays_bounded():
    framer = Framer(max_lines=10)
    framer.send(*CSI)
    for _ in range(100):
        framer.feed(b'+QNWCFG: "nr5g_csi",13,2,8,896\r\n' * 100)
    (answer,) = framer.feed(b"OK\r\n")
    assert len(answer.lines) == 10
    assert "too_many_lines:9990" in answer.flags


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=8))
def test_any_bytes_in_any_pieces(data, cuts):
    places = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    pieces = [data[a:b] for a, b in pairwise(places)]
    assert live(pieces) == live([data])


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.sampled_from([b"OK", b"ERROR", b"RDY", b'+QNWCFG: "nr5g_csi",1,2,3,4', b'+QENG: "x"', b"junk"]), max_size=20
    )
)
def test_every_line_comes_out_once(lines):
    framer = sent(CSI)
    events = framer.feed(b"".join(line + b"\r\n" for line in lines))
    if framer._open is not None:
        events.append(framer.give_up())
    events += framer.settle()
    count = 0
    for event in events:
        if isinstance(event, Unsolicited):
            count += 1
        elif isinstance(event, Late):
            count += len(event.lines) + (event.status != "cut")
        else:
            count += len(event.lines) + (event.status not in ("timeout", "lost"))
    assert count == len(lines)
