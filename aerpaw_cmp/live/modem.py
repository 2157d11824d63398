"""Commands that the tap may send to a Quectel RM5xxQ, and the meaning of its answers.

Only commands in :data:`QUERIES` are sent, and these do not change the modem. The only command that changes it,
``csi_ctrl``, needs ``allow_csi=True``. No command requests IMEI, IMSI, ICCID or telephone numbers. If the modem sends
these data unasked, :class:`Redactor` removes them.

Layouts: Quectel RG520N&RG525F&RG5x0F&RM5x0N Series AT Commands Manual, section 5.20 (QENG); ``nr5g_csi`` as quoted
at community.teltonika.lt/t/read-csi-information/5568. SA and EN-DC order RSRQ and SINR differently, so the meaning of a
field depends on the line's radio access technology, not on its position alone. A field outside its physical range
becomes None with a flag. All other fields and the raw line are kept.

The module converts bytes of an AT port to answers and unsolicited lines, without file, port or clock.

:class:`Framer` is informed of the command in flight. The parser returns the same events regardless of how the bytes are
split. The buffer is bounded: a line is stored up to :data:`_MAX_LINE_BYTES`, and an answer up to ``max_lines``. The
rest is only counted.

A line ends at any run of CR and LF (a modem with echo ends the echo with CR CR LF). Bytes become text as Latin-1,
so no byte is lost.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

from ..common.errors import UsageError

Values = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Query:
    """One read-only command.

    Parameters
    ----------
    name : str
        Name of the query in settings and in the log.
    text : str
        The command, without line end.
    prefixes : tuple of str, or None
        Prefixes of the information lines of its answer, without spaces. None: any line.
    decode : callable
        ``decode(lines, flags) -> values``; appends to ``flags``.
    """

    name: str
    text: str
    prefixes: tuple[str, ...] | None
    decode: Callable[[Sequence[str], list[str]], Values]


@dataclass(frozen=True, slots=True)
class Decoded:
    """The values of one answer, and flags for invalid fields."""

    values: Values = field(default_factory=dict)
    flags: tuple[str, ...] = ()


# fields -------------------------------------------------------------------------------------------------------

_FIELD = re.compile(r'\s*("[^"]*"?|[^,]*)\s*(?:,|$)')


def _split_fields(payload: str) -> list[str | None]:
    """Split comma-separated fields and remove quotes. ``-`` and empty fields are None.

    Examples
    --------
    >>> _split_fields('"NR5G-SA","TDD", 515,66,-,"-"')
    ['NR5G-SA', 'TDD', '515', '66', None, None]
    """
    fields: list[str | None] = []
    position = 0
    while position <= len(payload):
        match = _FIELD.match(payload, position)
        if match is None:  # text after a closing quote: keep it as one field
            stop = payload.find(",", position)
            stop = len(payload) if stop < 0 else stop
            text, position = payload[position:stop], stop + 1
        else:
            text, position = match.group(1), match.end() if match.group(0).endswith(",") else len(payload) + 1
        text = text.strip().strip('"').strip()
        fields.append(None if text in ("", "-") else text)
    return fields


def _payload_of(line: str, prefix: str) -> str | None:
    """Return the text after ``prefix``, without colon and spaces. None if the line does not start with ``prefix``."""
    if not line.startswith(prefix):
        return None
    return line[len(prefix) :].lstrip(": ")


# Physical range of each field: TS 38.214 table 5.1.3.1 (mcs), TS 38.133 10.1.6-10.1.16 (rsrp, rsrq, sinr),
# TS 38.104 5.4.2.1 (arfcn).
_RANGES: Mapping[str, tuple[int, int]] = {
    "mcs": (0, 31),
    "ri_raw": (0, 8),
    "cqi": (0, 15),
    "pmi": (0, 65_535),
    "mcc": (1, 999),
    "mnc": (0, 999),
    "pcid": (0, 1007),
    "arfcn": (0, 3_279_165),
    "band": (1, 1024),
    "rsrp_dbm": (-156, -31),
    "rsrq_db": (-43, 20),
    "sinr_db": (-23, 40),
    "sinr_raw": (-200, 250),
    "rssi_dbm": (-120, 0),
    "srxlev_db": (-200, 200),
    "scs_code": (0, 4),
    "bandwidth_code": (0, 16),
    "uplink_bandwidth_code": (0, 16),
    "tx_power_tenth_dbm": (-600, 300),
}
# Quectel's value for "unknown", and this value divided by ten. Some fields have additional values for "unknown".
_MISSING = (-32768, -3276)
_MISSING_OF = {"cqi": 255, "pcid": 65_535}

_NR_BANDWIDTH_MHZ = (5, 10, 15, 20, 25, 30, 40, 50, 60, 70, 80, 90, 100, 200, 400, 35, 45)
_LTE_BANDWIDTH_MHZ = (1.4, 3, 5, 10, 15, 20)


def number(name: str, text: str | None, flags: list[str], *, prefix: str = "") -> int | None:
    """Return an integer field in its range, else None. The reason is added to ``flags``.

    Parameters
    ----------
    name : str
        Name of the field, a key of ``_RANGES``.
    text : str or None
        Text from the modem.
    flags : list of str
        Receives the reason for a missing value.
    prefix : str
        Text before the name of the field in the flag.

    Returns
    -------
    int or None

    Examples
    --------
    >>> flags = []
    >>> number("sinr_db", "180", flags), flags
    (None, ['sinr_db:out_of_range(180)'])
    """
    if text is None:
        return None
    if re.fullmatch(r"[+-]?\d{1,9}", text) is None:
        flags.append(f"{prefix}{name}:not_a_number")
        return None
    value = int(text)
    if value in _MISSING or value == _MISSING_OF.get(name):
        return None
    if not _RANGES[name][0] <= value <= _RANGES[name][1]:
        flags.append(f"{prefix}{name}:out_of_range({value})")
        return None
    return value


_WORDS = frozenset({"duplex", "cell_id", "tac", "state", "rat"})


def _named(names: Sequence[str], fields: Sequence[str | None], flags: list[str], prefix: str) -> Values:
    """Return fields under their names. Missing fields are None, and unknown further fields are in ``extra``."""
    values: Values = {}
    for index, name in enumerate(names):
        text = fields[index] if index < len(fields) else None
        values[name] = text if name in _WORDS else number(name, text, flags, prefix=prefix)
    if len(fields) > len(names):
        values["extra"] = list(fields[len(names) :])
    return values


def _fields_of(lines: Sequence[str], prefix: str, flags: list[str]) -> Iterator[list[str | None]]:
    """Yield the fields of lines that start with a prefix. Add a flag for each other line."""
    for line in lines:
        payload = _payload_of(line, prefix)
        if payload is None:
            flags.append("foreign_line")
        else:
            yield _split_fields(payload)


# answers ------------------------------------------------------------------------------------------------------


def _decode_csi(lines: Sequence[str], flags: list[str], which: str) -> Values:
    """Decode ``+QNWCFG: "nr5g_csi",<mcs>,<ri>,<cqi>,<pmi>``. RI 0 means no CSI, so ``rank`` is then None."""
    rows = []
    for line in lines:
        payload = _payload_of(line, "+QNWCFG")
        fields = [] if payload is None else _split_fields(payload)
        if fields and fields[0] == which:
            rows.append(fields[1:])
    if not rows:
        flags.append("no_csi_line")
        return {"rank": None, "ri_raw": None}
    if len(rows) > 1:
        flags.append(f"csi_lines:{len(rows)}")
    fields = rows[-1]
    if len(fields) < 4:
        flags.append(f"torn:{len(fields)}_of_4_fields")
        return {"rank": None, "ri_raw": None, "extra": fields}
    values = _named(("mcs", "ri_raw", "cqi", "pmi"), fields, flags, "")
    values["rank"] = values["ri_raw"] or None
    if values["ri_raw"] == 0:
        flags.append("no_csi")
        if not any(values[name] for name in ("mcs", "cqi", "pmi")):
            values.update(mcs=None, cqi=None, pmi=None)
    return values


_SA = (
    *("duplex", "mcc", "mnc", "cell_id", "pcid", "tac", "arfcn", "band", "bandwidth_code"),
    *("rsrp_dbm", "rsrq_db", "sinr_db", "scs_code", "srxlev_db"),
)
_NSA = ("mcc", "mnc", "pcid", "rsrp_dbm", "sinr_db", "rsrq_db", "arfcn", "band", "bandwidth_code", "scs_code")
_NR: Mapping[str | None, Sequence[str]] = {"NR5G-SA": _SA, "NR5G-NSA": _NSA}
_LTE = (
    *("duplex", "mcc", "mnc", "cell_id", "pcid", "arfcn", "band", "uplink_bandwidth_code", "bandwidth_code", "tac"),
    *("rsrp_dbm", "rsrq_db", "rssi_dbm", "sinr_raw", "cqi", "tx_power_tenth_dbm", "srxlev_db"),
)


def _nr(names: Sequence[str], fields: Sequence[str | None], flags: list[str]) -> Values:
    values = _named(names, fields, flags, "nr.")
    code = values.get("bandwidth_code")
    values["bandwidth_mhz"] = None if code is None else _NR_BANDWIDTH_MHZ[code]
    scs = values.get("scs_code")
    values["scs_khz"] = None if scs is None else 15 * 2**scs
    if values.get("pcid") is None and values.get("rsrp_dbm") is None:
        flags.append("nr_absent")
    return values


def _lte(fields: Sequence[str | None], flags: list[str]) -> Values:
    # 'sinr_raw' has no unit: it is in dB or 5 X - 20 depending on the firmware, and the manual does not specify which
    values = _named(_LTE, fields, flags, "lte.")
    code = values["bandwidth_code"]
    values["bandwidth_mhz"] = _LTE_BANDWIDTH_MHZ[code] if code is not None and code < len(_LTE_BANDWIDTH_MHZ) else None
    return values


def _decode_servingcell(lines: Sequence[str], flags: list[str]) -> Values:
    """Decode ``+QENG`` of SA, EN-DC (three lines) and LTE, distinguished by the token of each line."""
    values: Values = {"state": None, "rat": None}
    for fields in _fields_of(lines, "+QENG", flags):
        if fields[0] == "servingcell":
            values["state"] = fields[1] if len(fields) > 1 else None
            fields = fields[2:]
            if not fields:
                continue
        rat, cell = fields[0], fields[1:]
        if rat in _NR:
            values["nr"] = _nr(_NR[rat], cell, flags)
        elif rat == "LTE":
            values["lte"] = _lte(cell, flags)
        else:
            flags.append(f"unknown_rat:{str(rat)[:16]}")
            continue
        values["rat"] = "EN-DC" if {"nr", "lte"} <= values.keys() else rat
    return values


def _decode_antennas(lines: Sequence[str], flags: list[str], command: str, kind: str) -> Values:
    """Decode ``+QRSRP: <PRX>,<DRX>,<RX2>,<RX3>[,<sysmode>]``, one line per radio access technology.

    Parameters
    ----------
    lines : sequence of str
        Lines of the answer.
    flags : list of str
        Receives flags for unusual content.
    command, kind : str
        Name of the answer, such as ``+QRSRP``, and the key of its values in the result.

    Returns
    -------
    dict
        By radio access technology: ``{kind: [level of each receiver, None if unknown]}`` [dBm or dB], and ``extra``
        fields.
    """
    values: Values = {}
    for fields in _fields_of(lines, command, flags):
        tag = "untagged"
        if fields and fields[-1] is not None and not re.fullmatch(r"[+-]?\d+", fields[-1]):
            tag = str(fields.pop())[:16]
        levels = [number(kind, text, flags, prefix=f"{tag}.rx{i}.") for i, text in enumerate(fields[:4])]
        if kind == "rsrp_dbm":
            flags += [f"{tag}.rx{i}.floor" for i, level in enumerate(levels) if level in (-140, -44)]
        values[tag] = {kind: levels}
        if len(fields) > 4:
            values[tag]["extra"] = fields[4:]
    return values


def _decode_text(lines: Sequence[str], _flags: list[str]) -> Values:
    """Return answers that are stored but not evaluated."""
    return {"text": list(lines)}


def _decode_csi_ctrl(lines: Sequence[str], flags: list[str]) -> Values:
    """Decode ``+QNWCFG: "csi_ctrl",<lte>,<nr5g>``."""
    for line in lines:
        match = re.match(r'\+QNWCFG: ?"csi_ctrl", ?([01]), ?([01])$', line)
        if match:
            return {"lte": int(match.group(1)), "nr5g": int(match.group(2))}
    flags.append("no_csi_ctrl_line")
    return {}


def _decode_identity(lines: Sequence[str], flags: list[str]) -> Values:
    """Decode the answer to ``ATI``: maker, model and ``Revision:``."""
    values: Values = {"text": [line for line in lines if not line.startswith("Revision:")]}
    for line in lines:
        if line.startswith("Revision:"):
            values["revision"] = line[9:].strip()
    if "revision" not in values:
        flags.append("no_revision")
    return values


# Queries that the tap may send, by name.
QUERIES: Mapping[str, Query] = {
    query.name: query
    for query in (
        Query("sync", "AT", (), lambda _lines, _flags: {}),
        Query("identity", "ATI", None, _decode_identity),
        Query("firmware", "AT+CGMR", None, _decode_text),
        Query("csi_ctrl", 'AT+QNWCFG="csi_ctrl"', ('+QNWCFG:"csi_ctrl"',), _decode_csi_ctrl),
        Query("nr5g_csi", 'AT+QNWCFG="nr5g_csi"', ('+QNWCFG:"nr5g_csi"',), partial(_decode_csi, which="nr5g_csi")),
        Query("lte_csi", 'AT+QNWCFG="lte_csi"', ('+QNWCFG:"lte_csi"',), partial(_decode_csi, which="lte_csi")),
        Query("servingcell", 'AT+QENG="servingcell"', ("+QENG:",), _decode_servingcell),
        Query("qrsrp", "AT+QRSRP", ("+QRSRP:",), partial(_decode_antennas, command="+QRSRP", kind="rsrp_dbm")),
        Query("qrsrq", "AT+QRSRQ", ("+QRSRQ:",), partial(_decode_antennas, command="+QRSRQ", kind="rsrq_db")),
        Query("qsinr", "AT+QSINR", ("+QSINR:",), partial(_decode_antennas, command="+QSINR", kind="sinr_db")),
        Query("qnwinfo", "AT+QNWINFO", ("+QNWINFO:",), _decode_text),
        Query("qcainfo", "AT+QCAINFO", ("+QCAINFO:",), _decode_text),
    )
}

RI_QUERY = "nr5g_csi"
# Queries that are polled at the slower rate, in this order.
OTHER_QUERIES = ("servingcell", "qrsrp", "qsinr", "lte_csi", "qrsrq", "qnwinfo", "qcainfo")

_BY_TEXT = {query.text: query for query in QUERIES.values()}
_CSI_WRITE = re.compile(r'AT\+QNWCFG="csi_ctrl",[01],[01]')


def csi_write(lte: int, nr5g: int) -> str:
    """Return the command that switches CSI reporting. No other command of the tap changes the modem."""
    return f'AT+QNWCFG="csi_ctrl",{int(bool(lte))},{int(bool(nr5g))}'


def encode(command: str, *, allow_csi: bool = False) -> bytes:
    r"""Return the bytes of an allowed command.

    Raises
    ------
    UsageError
        If the command is not on the list, contains CR, LF or ``;``, or changes the modem without ``allow_csi``.

    Examples
    --------
    >>> encode("AT+QRSRP")
    b'AT+QRSRP\r'
    """
    if command in _BY_TEXT or (allow_csi and _CSI_WRITE.fullmatch(command)):
        return command.encode("ascii") + b"\r"
    writes = _CSI_WRITE.fullmatch(command) is not None
    raise UsageError(
        f"command {command[:60]!a} is not allowed",
        expected="one of " + ", ".join(_BY_TEXT),
        cause="switching CSI reporting needs --enable-csi" if writes else "the tap sends read-only queries only",
    )


def decode(name: str, lines: Sequence[str]) -> Decoded:
    """Decode the information lines of a query's answer. No answer of a modem raises an exception.

    Examples
    --------
    >>> decode("nr5g_csi", ['+QNWCFG: "nr5g_csi",13,2,8,896']).values["rank"]
    2
    """
    flags: list[str] = []
    values = QUERIES[name].decode(lines, flags)
    return Decoded(values, tuple(dict.fromkeys(flags)))


# personal data ------------------------------------------------------------------------------------------------

_PERSONAL = re.compile(
    r"\d{2}-\d{6}-\d{6}-\d"  # IMEI with separators
    r"|\+\d{7,}"  # international number
    r"|\d{10,}F?"  # IMEI, IMSI, ICCID, national number; cell identities have at most 9 hex digits
)
_PRIVATE_ANSWER = re.compile(
    r"\+(CNUM|CLIP|CMT|CMGR|CMGL|CDS|CUSD|COLP|CLCC|CBM|CIMI|CGSN|GSN|QCCID|CCID|ICCID|EGMR|CPBR|CSCA)\b"
)
_MESSAGE_FOLLOWS = re.compile(r"\+(CMT|CMGR|CMGL|CDS|CBM):")
_CUT_NUMBER = re.compile(r"\d{5,}$")


class Redactor:
    """A filter that removes IMEI, IMSI, ICCID, telephone numbers and message texts from lines, in order of arrival.

    Examples
    --------
    >>> Redactor().clean("IMEI: 490154203237518")
    'IMEI: <redacted>'
    >>> Redactor().clean('+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,7')
    '+QENG: "servingcell","NOCONN","NR5G-SA","TDD",999,99,0002A4001,7'
    """

    def __init__(self) -> None:
        self._message_follows = False
        self.count = 0

    def clean(self, text: str, *, cut: bool = False) -> str:
        """Return the line without personal data. ``cut`` means that the end of the line is missing."""
        if self._message_follows and not text.startswith("+Q"):  # an answer may come before the message
            self._message_follows = False
            self.count += 1
            return "<redacted message>"
        self._message_follows = _MESSAGE_FOLLOWS.search(text) is not None
        private = _PRIVATE_ANSWER.search(text)
        if private:
            self.count += 1
            return text[: private.end()] + ": <redacted>"
        cleaned, count = _PERSONAL.subn("<redacted>", text)
        if cut:
            cleaned, more = _CUT_NUMBER.subn("<redacted>", cleaned)
            count += more
        self.count += count
        return cleaned


_MAX_LINE_BYTES = 65_536
_MAX_LINES = 256

Status = Literal["ok", "error", "cme", "cms", "timeout", "lost", "cut"]


@dataclass(frozen=True, slots=True)
class Answer:
    """The response to one command.

    Parameters
    ----------
    command : str or None
        The command. None if a transcript does not contain it.
    lines : tuple of str
        Information lines, without echo and final result.
    status : str
        ``ok``, ``error``, ``cme``, ``cms``, or the reason why there is no final result: ``timeout``, ``lost`` (the port
        is gone), ``cut`` (the next command or the end of a transcript followed).
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
    """A line that does not belong to a command. ``dropped`` is the number of bytes of the line that were not stored."""

    text: str
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class Late:
    """An answer that came after the time-out of its command. A late answer is stored, but not assigned to a query."""

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
    """Return status and code if the line is a final result, else None (3GPP TS 27.007, clause 9; TS 27.005, 3.2.5).

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
    """Check whether a line is of a kind that modems send unasked (some are also answers to a query)."""
    return _UNSOLICITED.match(text) is not None


def unglue(text: str) -> tuple[str, ...]:
    """Split answers that a modem put on one line. Quotes protect text that looks like a start.

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


@dataclass(slots=True)
class _Open:
    """The command in flight, and the lines received for it."""

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
    r"""A parser of the answers to known commands, one of which is in flight at a time.

    A command that timed out may still be answered. A late answer becomes a :class:`Late` event. The prefix of the
    lines, or the echo if the modem echoes, distinguishes a late answer from the answer to the next command.

    Parameters
    ----------
    max_lines : int
        Number of lines of an answer that are stored.

    Examples
    --------
    >>> framer = Framer()
    >>> framer.send('AT+QNWCFG="nr5g_csi"', ('+QNWCFG:"nr5g_csi"',))
    >>> framer.feed(b'\r\n+QNWCFG: "nr5g_csi",13,2,8,896\r\n\r\nOK\r\n')[0].lines
    ('+QNWCFG: "nr5g_csi",13,2,8,896',)
    """

    def __init__(self, *, max_lines: int = _MAX_LINES) -> None:
        self._partial, self._dropped = bytearray(), 0
        self._max_lines = max_lines
        self._open: _Open | None = None
        self._owed: list[_Open] = []
        self._stray: list[str] = []
        self._echo_seen = False

    def send(self, command: str, prefixes: tuple[str, ...] | None) -> None:
        """Register the command that is sent now.

        Parameters
        ----------
        command : str
            Command as written to the port, without the line end.
        prefixes : tuple of str, or None
            Prefixes of the information lines of its answer, without spaces. ``()``: no lines. None: any line.
        """
        self._open = _Open(command, prefixes, [], [])

    def feed(self, data: bytes) -> list[Event]:
        """Return the events that these bytes complete, in order."""
        events: list[Event] = []
        *ends, rest = re.split(rb"[\r\n]", data)
        for end in ends:
            self._keep(end)
            text, dropped = self._take_partial().strip(" \t"), self._dropped
            self._dropped = 0
            if not text and not dropped:
                continue
            pieces = (text,) if dropped else unglue(text)
            if len(pieces) > 1:
                self._flag("glued")
            for piece in pieces:
                self._line(piece, dropped, events)
        self._keep(rest)
        return events

    def _keep(self, part: bytes) -> None:
        """Append to the unfinished line, and count the bytes beyond its limit."""
        room = _MAX_LINE_BYTES - len(self._partial)
        self._partial += part[:room]
        self._dropped += max(0, len(part) - room)

    def _take_partial(self) -> str:
        """Return the unfinished line and remove it."""
        text = self._partial.decode("latin-1")
        self._partial.clear()
        return text

    def give_up(self, status: Literal["timeout", "lost"] = "timeout") -> Answer:
        """End the command in flight without a final result.

        After ``timeout``, the answer may still come late. After ``lost``, the buffer is emptied.
        """
        assert self._open is not None
        now, self._open = self._open, None
        partial = self._partial.decode("latin-1")
        answer = Answer(now.command, tuple(now.lines), status, flags=tuple(now.flags), partial=partial)
        self._echo_seen = now.echoed  # a reset modem may have stopped echoing
        if status == "lost":
            self._partial.clear()
            self._dropped = 0
            self._owed.clear()
        else:
            self._owed.append(now)
            # limit the list: a modem that never answers must not fill the memory
            del self._owed[:-16]
        return answer

    def leave(self) -> tuple[tuple[str, ...], str]:
        """Return and remove the stored lines that do not belong to an answer, and the unfinished line."""
        lines, self._stray = tuple(self._stray), []
        self._owed.clear()
        self._dropped = 0
        return lines, self._take_partial()

    def settle(self) -> list[Event]:
        """Stop expecting late answers, because a probe was answered after all earlier commands."""
        self._owed.clear()
        if not self._stray:
            return []
        lines, self._stray = tuple(self._stray), []
        return [Late(lines, "cut")]

    # one line ---------------------------------------------------------------------------------------------

    def _line(self, text: str, dropped: int, events: list[Event]) -> None:
        final = _final_result(text)
        if final is not None:
            self._final(*final, events)
            return
        now = self._open
        if now is not None and self._is_echo(text, now):
            return
        if any(text == owed.command for owed in self._owed):
            return
        if now is not None and _matches(text, now.prefixes):
            if dropped:
                self._flag(f"overlong:{dropped}")
            if len(now.lines) < self._max_lines:
                now.lines.append(text)
            else:
                now.too_many += 1
        elif any(_matches(text, owed.prefixes) for owed in self._owed) and len(self._stray) < self._max_lines:
            self._stray.append(text)
        else:
            events.append(Unsolicited(text, dropped))

    def _is_echo(self, text: str, now: _Open) -> bool:
        # remains of earlier output may precede the echo on the same line
        upper, command = text.upper(), now.command.upper()
        # require long commands, because many lines that are not an echo end with a short command such as AT
        if now.echoed or not (upper == command or (len(command) > 6 and upper.endswith(command))):
            return False
        now.echoed = self._echo_seen = True
        self._flag("echo" if len(text) == len(now.command) else "echo_with_rubbish")
        if self._owed and now.lines:  # lines before our echo belong to an earlier command
            self._stray += now.lines
            now.lines.clear()
        return True

    def _final(self, status: Status, code: str | None, events: list[Event]) -> None:
        now = self._open
        if now is None or self._is_owed_final(now, status):
            if now is not None:  # before our echo, so it answers an earlier command
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
        """Check whether a final result ends a late answer. A modem answers commands in order."""
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
