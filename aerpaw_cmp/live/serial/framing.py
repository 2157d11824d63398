"""Bytes of an AT port to answers and unsolicited lines: no file, no port, no clock.

:class:`Framer` knows the command in flight. It gives the same events however the bytes are cut into pieces, and holds
a bounded buffer: a line is kept up to :data:`_MAX_LINE_BYTES`, an answer up to ``max_lines``; the rest is counted, not
stored.

A line ends at any run of CR and LF (a modem with echo ends the echo with CR CR LF). Bytes become text as Latin-1,
so nothing that came in is lost, whatever it was.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

_MAX_LINE_BYTES = 65_536
_MAX_LINES = 256

Status = Literal["ok", "error", "cme", "cms", "timeout", "lost", "cut"]


@dataclass(frozen=True, slots=True)
class Line:
    """One line without its end; ``dropped`` bytes of it were not kept."""

    text: str
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Answer:
    """Response to one command.

    Parameters
    ----------
    command : str or None
        None where a transcript does not show it.
    lines : tuple of str
        Information lines, without echo and final result.
    status : str
        ``ok``, ``error``, ``cme``, ``cms``; or how it ended without a final result: ``timeout``, ``lost``
        (port gone), ``cut`` (the next command or the end of a transcript).
    code : str or None
        Text after ``+CME ERROR:`` or ``+CMS ERROR:``.
    flags : tuple of str
        ``echo``, ``glued``, ``overlong:<bytes dropped>``, ``too_many_lines:<dropped>``, ``ambiguous``.
    partial : str
        Unfinished line at a time-out or loss.
    """

    command: str | None
    lines: tuple[str, ...]
    status: Status
    code: str | None = None
    flags: tuple[str, ...] = ()
    partial: str = ""


@dataclass(frozen=True, slots=True)
class Unsolicited:
    """A line that belongs to no command."""

    text: str
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Late:
    """An answer that came after its time-out: kept, matched to nothing."""

    lines: tuple[str, ...]
    status: Status
    code: str | None = None


Event = Answer | Unsolicited | Late

_UNSOLICITED = re.compile(
    r"(RDY|APP RDY|RING|POWERED DOWN|NORMAL POWER DOWN|NO CARRIER|SMS DONE|PB DONE)$"
    r"|\+(QUSIM|QIND|QGPSURC|QLWURC|QIURC|QNETDEVSTATUS|CREG|CGREG|CEREG|C5GREG|CGEV|CMTI|CMT|CDS|CDSI|CBM|CLIP"
    r"|CRING|CCWA|CUSD|CTZV|CTZE|CTZDST|CPIN|CFUN):"
)
_GLUE = re.compile(r"\"|\+[A-Z][A-Z0-9]{1,15}(?: ERROR)?:")
_GLUED_OK = re.compile(r"[0-9\"\-]OK$")


def _final_result(text: str) -> tuple[Status, str | None] | None:
    """Status and code if the whole line is a final result, else None (3GPP TS 27.007, clause 9; TS 27.005, 3.2.5).

    Examples
    --------
    >>> _final_result("+CME ERROR: 516")
    ('cme', '516')
    >>> _final_result('+QNWINFO: "TDD NR5G","TOKYO OK"') is None
    True
    """
    if text == "OK":
        return "ok", None
    if text == "ERROR":
        return "error", None
    for start, status in (("+CME ERROR:", "cme"), ("+CMS ERROR:", "cms")):
        if text.startswith(start):
            return status, text[len(start) :].strip()  # type: ignore[return-value]
    return None


def is_unsolicited(text: str) -> bool:
    """Check whether a line is of a kind that modems send unasked (some are answers too, to their own query)."""
    return _UNSOLICITED.match(text) is not None


def unglue(text: str) -> tuple[str, ...]:
    """Answers that a modem put on one line, apart; quotes protect what looks like a start.

    Examples
    --------
    >>> unglue('+QCAINFO: "SCC",7,-,-+QCAINFO: "SCC",8')
    ('+QCAINFO: "SCC",7,-,-', '+QCAINFO: "SCC",8')
    >>> unglue('+QSPN: "X+CREG: 1"')
    ('+QSPN: "X+CREG: 1"',)
    """
    if not text.startswith("+"):
        return (text,)
    cuts, quoted = [0], False
    for match in _GLUE.finditer(text):
        if match.group() == '"':
            quoted = not quoted
        elif not quoted and match.start() > 0:
            cuts.append(match.start())
    pieces = [text[a:b] for a, b in zip(cuts, [*cuts[1:], len(text)], strict=True)]
    last = pieces[-1]
    if not quoted and _GLUED_OK.search(last):
        pieces[-1:] = [last[:-2], "OK"]
    return tuple(piece.strip() for piece in pieces)


class LineBuffer:
    """Bytes to lines with a bounded buffer: of a longer line the rest is counted in :attr:`Line.dropped`."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._dropped = 0

    def feed(self, data: bytes) -> Iterator[Line]:
        """Complete lines, blank ones left out."""
        start = 0
        for match in _LINE_END.finditer(data):
            self._keep(data, start, match.start())
            start = match.end()
            yield from self.flush()
        self._keep(data, start, len(data))

    def _keep(self, data: bytes, start: int, stop: int) -> None:
        room = max(0, _MAX_LINE_BYTES - len(self._buffer))
        self._buffer += data[start : min(stop, start + room)]
        self._dropped += max(0, stop - start - room)

    def peek(self) -> str:
        """The unfinished line."""
        return self._buffer.decode("latin-1")

    def flush(self) -> list[Line]:
        """The unfinished line as a line, if it is not blank; the buffer is empty then."""
        text = self._buffer.decode("latin-1").strip(" \t")
        line = Line(text, self._dropped)
        self._buffer.clear()
        self._dropped = 0
        return [line] if text or line.dropped else []


_LINE_END = re.compile(rb"[\r\n]+")


@dataclass(slots=True)
class _Open:
    """The command in flight, and what came for it."""

    command: str
    prefixes: tuple[str, ...] | None
    lines: list[str]
    flags: list[str]
    echoed: bool = False
    too_many: int = 0


def _matches(text: str, prefixes: tuple[str, ...] | None) -> bool:
    if prefixes is None:
        return not is_unsolicited(text)
    return text.replace(" ", "").startswith(prefixes)


class Framer:
    r"""Answers to known commands, one in flight at a time.

    A command that timed out still owes an answer. What comes for it later is a :class:`Late` event, told from the
    next command's answer by its prefix, or by the echo where the modem echoes.

    Parameters
    ----------
    max_lines : int
        Of an answer that are kept.

    Examples
    --------
    >>> framer = Framer()
    >>> framer.send('AT+QNWCFG="nr5g_csi"', ('+QNWCFG:"nr5g_csi"',))
    >>> framer.feed(b'\r\n+QNWCFG: "nr5g_csi",13,2,8,896\r\n\r\nOK\r\n')[0].lines
    ('+QNWCFG: "nr5g_csi",13,2,8,896',)
    """

    def __init__(self, *, max_lines: int = _MAX_LINES) -> None:
        self._buffer = LineBuffer()
        self._max_lines = max_lines
        self._open: _Open | None = None
        self._owed: list[_Open] = []
        self._stray: list[str] = []
        self._echo_seen = False

    def send(self, command: str, prefixes: tuple[str, ...] | None) -> None:
        """A command goes out.

        Parameters
        ----------
        command : str
            As written to the port, without its end.
        prefixes : tuple of str, or None
            Starts of its information lines, without blanks; ``()`` if it has none, None if any line may be one.
        """
        self._open = _Open(command, prefixes, [], [])

    def feed(self, data: bytes) -> list[Event]:
        """Events that these bytes complete, in their order."""
        events: list[Event] = []
        for line in self._buffer.feed(data):
            pieces = unglue(line.text) if not line.dropped else (line.text,)
            if len(pieces) > 1 and self._open is not None:
                self._flag("glued")
            for piece in pieces:
                self._line(Line(piece, line.dropped), events)
        return events

    def give_up(self, status: Literal["timeout", "lost"] = "timeout") -> Answer:
        """End the command in flight without a final result.

        After ``timeout`` its answer is owed and may come late; after ``lost`` the buffer is emptied.
        """
        assert self._open is not None
        now, self._open = self._open, None
        answer = Answer(
            command=now.command,
            lines=tuple(now.lines),
            status=status,
            code=None,
            flags=tuple(now.flags),
            partial=self._buffer.peek(),
        )
        self._echo_seen = now.echoed  # a reset modem may have stopped echoing
        if status == "lost":
            self._buffer.flush()
            self._owed.clear()
        else:
            self._owed.append(now)
            # a modem that never answers must not fill the memory
            del self._owed[:-16]
        return answer

    def leave(self) -> tuple[tuple[str, ...], str]:
        """Return and forget what is held and belongs to nothing: lines of owed answers, and the unfinished line."""
        lines, self._stray = tuple(self._stray), []
        partial = self._buffer.peek()
        self._buffer.flush()
        self._owed.clear()
        return lines, partial

    def settle(self) -> list[Event]:
        """Forget what is owed (a probe was answered, so the modem is in step again)."""
        self._owed.clear()
        if not self._stray:
            return []
        lines, self._stray = tuple(self._stray), []
        return [Late(lines, "cut")]

    # one line ---------------------------------------------------------------------------------------------

    def _line(self, line: Line, events: list[Event]) -> None:
        text = line.text
        final = _final_result(text)
        if final is not None:
            self._final(final[0], final[1], events)
            return
        now = self._open
        if now is not None and self._is_echo(text, now):
            return
        if any(text == owed.command for owed in self._owed):
            return
        if now is not None and _matches(text, now.prefixes):
            self._own(line, now)
        elif any(_matches(text, owed.prefixes) for owed in self._owed) and len(self._stray) < self._max_lines:
            self._stray.append(text)
        else:
            events.append(Unsolicited(text, line.dropped))

    def _own(self, line: Line, now: _Open) -> None:
        """Take a line of the answer in flight."""
        if line.dropped:
            self._flag(f"overlong:{line.dropped}")
        if len(now.lines) < self._max_lines:
            now.lines.append(line.text)
        else:
            now.too_many += 1

    def _is_echo(self, text: str, now: _Open) -> bool:
        # rubbish from before may stand in front of the echo on the same line
        upper, command = text.upper(), now.command.upper()
        # a short command, as AT, ends many lines that are no echo
        if now.echoed or not (upper == command or (len(command) > 6 and upper.endswith(command))):
            return False
        now.echoed = self._echo_seen = True
        self._flag("echo" if len(text) == len(now.command) else "echo_with_rubbish")
        if self._owed and now.lines:  # they came before our echo, so they are not ours
            self._stray += now.lines
            now.lines.clear()
        return True

    def _final(self, status: Status, code: str | None, events: list[Event]) -> None:
        now = self._open
        if now is None or self._is_owed_final(now, status):
            if now is not None:  # before the echo of our command: not ours
                self._stray += now.lines
                now.lines.clear()
            events.append(Late(tuple(self._stray), status, code))
            self._stray.clear()
            del self._owed[:1]
            return
        if self._stray:
            events.append(Late(tuple(self._stray), "cut"))
            self._stray.clear()
        if self._owed and not now.lines:
            self._flag("ambiguous")
        if now.too_many:
            self._flag(f"too_many_lines:{now.too_many}")
        events.append(Answer(now.command, tuple(now.lines), status, code, tuple(now.flags)))
        self._open = None

    def _is_owed_final(self, now: _Open, status: Status) -> bool:
        """Check whether a final result ends an owed answer (a modem works off its commands in order)."""
        if not self._owed:
            return False
        if self._echo_seen and not now.echoed:
            return True
        if now.lines:
            return False
        return bool(self._stray) or (status == "ok" and now.prefixes != ())

    def _flag(self, flag: str) -> None:
        if self._open is not None and flag not in self._open.flags:
            self._open.flags.append(flag)
