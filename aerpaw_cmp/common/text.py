"""Short texts: the commands and their help, counts with nouns, cells of CSV files, HTML tables.

The commands and their one-line help are in this module, so that ``--help`` does not load any other module.

The module also formats counts with their nouns, and decodes lines of tables.

Text cells of CSV files are guarded, because names come from third-party logs, and a spreadsheet evaluates cells that
begin with = + - or @ as formulas.

Records are shown in notebooks as a small HTML table.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from typing import Any

COMMANDS: dict[str, str] = {
    "ingest": "Read logs of any known format, account for every line, write a flight file.",
    "formats": "List the log formats that can be read, with a sample line of each.",
    "report": "Replay a flight, compare it with the measurement, and write the report.",
    "campaign": "Compare many flights and settings: held-out errors, steps of offsets, repeatability.",
    "explain": "List every path of a link at one time: faces, angles, losses and total.",
    "diff": "Compare two reports of a flight: settings, inputs, numbers with intervals.",
    "calibrate": "Learn antennas from several flights and score them on held-out data.",
    "tap": "Log the rank indicator live from the modem's serial port.",
    "modem-sim": "Simulate the modem on a pseudo-terminal, to try the tap without hardware.",
    "predict": "Predict level and rank with error bars on a route, a grid or points.",
    "plan": "Rank candidate flights by how much they reduce the prediction's standard deviation.",
    "locate": "Locate an unknown ground transmitter or receiver from the levels of a flight.",
    "channel": "Write the channel along a flight or a route: paths, H, Doppler, levels.",
    "map": "Map coverage and rank of a site, with Kriging of rank and its baselines.",
    "simulate": "Write the logs of a planned flight in the real formats, with their ground truth.",
    "sample": "Copy the sample flight, logs and flight.yaml, into a new folder.",
    "site": "Make a site from maps or a Mitsuba scene (import), show it, export it.",
    "antenna": "Write an antenna pattern in the formats of other programs (export).",
    "bench": "Measure speed and error of the replay on this machine.",
    "doctor": "Check this machine: LLVM, Sionna RT, memory, serial ports, with remedies.",
}


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun. The plural has an s unless it is given, and thousands are separated.

    Examples
    --------
    >>> counted(1, "task"), counted(0, "task"), len(counted(6608, "task").split())
    ('1 task', '0 tasks', 3)
    >>> counted(1, "row is", "rows are"), counted(2, "row is", "rows are")
    ('1 row is', '2 rows are')
    """
    # use a narrow no-break space, because many readers would read a comma as the decimal sign
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}".replace(",", "\N{NARROW NO-BREAK SPACE}")


# Start of a cell that has to be guarded. A cell may also begin after a semicolon. An apostrophe from the log is
# guarded, too, because unguarded() would otherwise remove it.
_BEGINNING = re.compile(r"(^|;)(?=[=+\-@\t\r'])")
_GUARDED = re.compile(r"(^|;)'")
# In a comment, a cell begins after a separator. Numbers are not guarded, because comments may contain tables of
# numbers.
_IN_COMMENT = re.compile(r"([,;\t]\s*)(?=[=@]|[+\-](?![\d.]|inf|nan))")


# Bytes that no text in Latin-1 contains: control characters, three accented letters in a row, and UTF-8.
_NOT_LATIN = re.compile(rb"[\x80-\x9f]|[\xa0-\xff]{3}|[\xc2-\xdf][\xa0-\xbf]")


def decoded(line: bytes) -> str:
    r"""Return a line decoded as UTF-8, or as Latin-1, which some programs in Western Europe write.

    Examples
    --------
    >>> decoded(b"H\xf6he [m]") == "H\u00f6he [m]", decoded(b"\x93\xfa\x8e\x9e") == 4 * "\ufffd"
    (True, True)
    """
    try:
        return line.decode("utf-8-sig")
    except UnicodeDecodeError:
        return line.decode("utf-8-sig" if _NOT_LATIN.search(line) else "latin-1", errors="replace")


def guarded(table: Any) -> Any:
    """Return a data frame in which an apostrophe precedes each text that a spreadsheet would evaluate as a formula.

    Numbers stay numbers. :func:`unguarded` restores the texts.
    """
    guarded_columns = {}
    for name in table.columns:
        if table[name].dtype.kind == "O" or str(table[name].dtype).startswith("str"):
            # check each distinct word once, because a million rows contain only a few different names
            words = [word for word in table[name].unique() if isinstance(word, str) and _BEGINNING.search(word)]
            if words:
                texts = table[name].astype(object)
                guarded_columns[name] = texts.replace({word: guarded_text(word) for word in words})
    # return a copy, because the caller reads numbers from its table afterwards
    return table.assign(**guarded_columns) if guarded_columns else table


def guarded_text(word: str) -> str:
    """Return a cell that spreadsheets do not treat as a formula.

    Examples
    --------
    >>> guarded_text("=1+1"), guarded_text("LW1;=1+1"), guarded_text("LW1")
    ("'=1+1", "LW1;'=1+1", 'LW1')
    """
    return _BEGINNING.sub(r"\1'", word)


def guarded_comment(line: str) -> str:
    """Return a comment line of a table with an apostrophe before each part that a spreadsheet would evaluate.

    Examples
    --------
    >>> guarded_comment("# learned: f1, =1+1"), guarded_comment("# pair: 1.5,-0.3")
    ("# learned: f1, '=1+1", '# pair: 1.5,-0.3')
    """
    return _IN_COMMENT.sub(r"\1'", line)


def unguarded(word: str) -> str:
    """Return the original text of a cell that :func:`guarded` wrote.

    Examples
    --------
    >>> unguarded("'=1+1"), unguarded("LW1")
    ('=1+1', 'LW1')
    """
    return _GUARDED.sub(r"\1", word)


def html_table(titles: Sequence[str], rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Return an HTML table with a head. Every text is escaped.

    Examples
    --------
    >>> html_table(["tower"], [["LW1"]])
    '<table><thead><tr><th>tower</th></tr></thead><tbody><tr><td>LW1</td></tr></tbody></table>'
    """
    head = "".join(f"<th>{html.escape(title)}</th>" for title in titles)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    # HTML only allows a caption as the first child of a table
    name = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    return f"<table>{name}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
