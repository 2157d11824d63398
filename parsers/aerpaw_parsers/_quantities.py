"""Names that phones and drive-test programs give to their quantities, in one table for all of them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from aerpaw_cmp.common.units import BoolArray, FloatArray
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.records import Attribute, Kind, Stream


@dataclass(frozen=True)
class Quantity:
    """Meaning of a name.

    Parameters
    ----------
    kind : str
        Of the stream that it gives.
    name : str
        The field's name of the quantity, e.g. ``RSRP``.
    unit : str
        Where the log writes none.
    """

    kind: Kind
    name: str
    unit: str


_TABLE: tuple[tuple[str, Quantity], ...] = (
    # the first that fits: 'PDSCH rank' before 'PDSCH throughput', 'RSSNR' before 'RSS'
    (r"\b(pdsch rank|rank indicat(or|ion)|ri|num(ber of)? layers|dl ri|dl layer num)\b", Quantity("rank", "rank", "")),
    (r"\brs ?rp\b|\bss ?rsrp\b|\b(nrx)?rsrp\b", Quantity("rss", "RSRP", "dBm")),
    (r"\b(nrx)?rsrq\b", Quantity("kpi", "RSRQ", "dB")),
    (r"\b(rs ?)?s(i)?nr\b|\brssnr\b", Quantity("kpi", "SINR", "dB")),
    (r"\brssi\b", Quantity("rss", "RSSI", "dBm")),
    (r"\bcqi\b", Quantity("kpi", "CQI", "")),
    (r"\bpath ?loss\b", Quantity("kpi", "path loss", "dB")),
    (r"\b(throughput|tput|bit ?rate|thr?put)\b", Quantity("kpi", "throughput", "bit/s")),
    (r"\bmcs\b", Quantity("kpi", "MCS", "")),
    (r"\bbler\b", Quantity("kpi", "BLER", "%")),
)
_COMPILED = tuple((re.compile(pattern), quantity) for pattern, quantity in _TABLE)


def plain(name: str) -> str:
    """A name in lower case with its marks as single spaces.

    Examples
    --------
    >>> plain("RSRP (LTE detected) - 1")
    'rsrp lte detected 1'
    """
    return re.sub(r"[^a-z0-9]+", " ", name.lower().replace("\u200b", "")).strip()


def quantity(name: str) -> Quantity | None:
    """Quantity that a name means, None if nothing that is known."""
    text = plain(name)
    return next((meaning for pattern, meaning in _COMPILED if pattern.search(text)), None)


# Columns that it alone has.
OF_GNETTRACK = ("networktech", "networkmode")
_GNETTRACK = {
    r"level": "rsrp", r"qual": "rsrq", r"psc": "pci", r"nrxlev(\d)": r"rsrp neighbour \1",
    r"nqual(\d)": r"rsrq neighbour \1", r"ncell(\d)": r"pci neighbour \1", r"narfcn(\d)": r"arfcn neighbour \1",
    r"lterssi": "rssi",
}  # fmt: skip
# Columns of srsUE's metrics file, whose time counts milliseconds.
SRSUE = {"time", "cc", "earfcn", "rsrp", "cfo"}
_SRSUE = {r"pl": "path loss"}
# By itself the word may be that of any list; beside a level of a cell it is the channel's.
_BARE = {r"rank": "rank indicator"}
_CELLMAPPER = {r"signal": "rsrp", r"psc or pci": "pci"}


def in_common_words(names: list[str]) -> list[str]:
    """Plain names, those that only one program uses in the words of all: G-NetTrack Pro's, srsUE's metrics file's."""
    present = set(names)
    programs = (
        (_GNETTRACK, {"level", "qual"} <= present and not present.isdisjoint(OF_GNETTRACK)),
        (_SRSUE, present >= SRSUE),
        (_CELLMAPPER, {"signal", "psc or pci"} <= present),
        (_BARE, "rank" in present and any(_is_level(name) for name in names)),
    )
    for pattern, word in next((table for table, applies in programs if applies), {}).items():
        names = [re.sub(f"^{pattern}$", word, name) for name in names]
    return names


def _is_level(name: str) -> bool:
    """Check whether a name is that of a level."""
    meaning = quantity(name)
    return meaning is not None and meaning.kind == "rss"


def is_rank(name: str) -> bool:
    """Check whether a name is that of a rank."""
    meaning = quantity(name)
    return meaning is not None and meaning.kind == "rank"


def stream(
    rows: _rows.Rows, name: str, values: FloatArray, *, unit: str = "", where: BoolArray | None = None,
    about: Mapping[str, Attribute | None] | None = None,
) -> Stream | None:  # fmt: skip
    """Level or KPI stream of a named quantity; of an unknown one, a KPI under its own name.

    Parameters
    ----------
    rows : Rows
    name : str
        As the log calls it.
    values : (n,)
    unit : str
        Where the quantity does not say.
    where : (n,) bool, optional
        Rows that count.
    about : mapping, optional
        Further attributes.
    """
    meaning = quantity(name) or Quantity("kpi", name, "")
    short = re.sub(r"\W+", "_", plain(name))
    if meaning.kind == "rss":
        level, flag = rows.level(values)
        return rows.stream(
            "rss", short, {"rss_db": level}, where=where, flag=flag, channel=rows.options.channel or short,
            unit=rows.options.unit or unit or meaning.unit, quantity=meaning.name, about=about,
        )  # fmt: skip
    return rows.stream(
        "kpi", short, {"value": values}, where=where, unit=unit or meaning.unit, quantity=meaning.name, about=about
    )
