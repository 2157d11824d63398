"""SigMF: the flight that dataset 12 keeps in its meta files, sounder positions, or power of the samples.

Dataset 12 (``captures[]``): ``measurement:values`` {mX, mY, mZ, RSS1, RSS2} with ``measurement:time_stamp``, and
``gps:position`` {x, y, z} with ``gps:time_stamp``; x is the longitude, y the latitude, z the height above take-off;
RSS in dB re full scale. A value is a list (a flight) or a number (a burst); a global field of the same name holds
for captures without it. Sounder: ``core:timestamp`` (epoch), ``core:rx_location``, ``core:rotation``,
``core:velocity``, ``core:frequency``.

Without values the power of each 20 ms of samples is read from the ``.sigmf-data`` beside: 10 log10 of the mean of
abs(x)^2 over all of the burst, dB re full scale of the data type. The lines of the account are those values.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.logs import lines as _lines
from aerpaw_cmp.logs import make_frames as _frames
from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import Reader, ReadOptions
from aerpaw_cmp.logs.records import ReadResult, RejectedLine, Stream

from . import _json, _stamps

_MOMENT = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(\.\d{1,9})?Z?")
BURST_S = 0.02
_SAMPLES = {
    "cf64": ("f8", 1.0), "cf32": ("f4", 1.0), "ci32": ("i4", 2.0**31), "ci16": ("i2", 2.0**15), "ci8": ("i1", 2.0**7),
    "cu8": ("u1", 2.0**7), "rf64": ("f8", 1.0), "rf32": ("f4", 1.0), "ri16": ("i2", 2.0**15),
}  # fmt: skip
_LEVELS = {"RSS1": "USRP1", "RSS2": "USRP2", "RSS": "USRP1", "rss1": "USRP1", "rss2": "USRP2"}
_PLACE = (("latitude_deg", ("mY", "y", "latitude", "lat")), ("longitude_deg", ("mX", "x", "longitude", "lon")),
          ("altitude_m", ("mZ", "z", "altitude", "alt")))  # fmt: skip


def sniff(head: bytes) -> bool:
    """Whether it is JSON with SigMF's three parts; the global one comes first as a rule."""
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    return text[:1] == b"{" and b'"core:datatype"' in head and (b'"captures"' in head or b'"global"' in head)


def _list(value: Any) -> list[Any]:
    if isinstance(value, list):
        return value
    return [] if value is None else [value]


def _merged(meta: dict[str, Any]) -> list[dict[str, Any]]:
    """Captures, each with the global fields that it lacks."""
    common = {key: value for key, value in _json.inside(meta, "global").items() if ":" in key}
    return [{**common, **capture} for capture in _json.listed(meta, "captures")] or [common]


def _column(captures: list[dict[str, Any]], field: str, *names: str) -> FloatArray:
    """A quantity of all captures, one behind the other."""
    out: list[float] = []
    for capture in captures:
        place = _json.inside(capture, field)
        values = next((place[name] for name in names if name in place), None)
        out += [_json.number(value) for value in _list(values)]
    return np.array(out, dtype=np.float64)


def _times(captures: list[dict[str, Any]], *fields: str) -> list[str]:
    found: list[str] = []
    for capture in captures:
        value = next((capture[field] for field in fields if field in capture), None)
        found += [str(one) for one in _list(value)]
    return found


def _stream(
    kind: str,
    name: str,
    texts: list[str],
    values: dict[str, AnyArray],
    options: ReadOptions,
    warnings: list[str],
    counts: list[int],
    **about: Any,
) -> Stream | None:
    """A stream of values with times; how many there are goes to ``counts``."""
    counts.append(len(texts))
    if not texts:
        return None
    clock, cells, clock_warnings = _stamps.read(texts, options)
    relative, instants, valid = _rows.times(cells, options, clock=clock, reader="sigmf")
    warnings += [*clock_warnings, *instants.warnings, *([_rows.RELATIVE] if relative else [])]
    flag = _lines.flags(len(texts))
    instants.flag(flag)
    if "rss_db" in values:
        silent = ~(values["rss_db"] > options.floor_db) | ~np.isfinite(values["rss_db"])
        _lines.add_flag(flag, silent, "out_of_coverage")
        values["rss_db"] = np.where(silent, np.nan, values["rss_db"])
    keep = np.flatnonzero(valid)
    kept = {key: np.asarray(column)[keep] for key, column in values.items()}
    frame = _frames.frame(kind, instants.time[keep], keep + 1, flag[keep], kept)  # type: ignore[arg-type]
    attributes = _frames.attributes(options, **({"clock": "relative"} if relative else {}), **about)
    return Stream(kind, name, frame, attributes) if len(frame) else None  # type: ignore[arg-type]


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Levels per channel and the track, from the meta file or from the samples beside it.

    Raises
    ------
    InputError
        If the file is no JSON, or holds neither values nor positions and its samples are not beside it.
    """
    try:
        meta = json.loads(data.decode("utf-8-sig", "replace"))
        captures = _merged(meta)
    except (ValueError, RecursionError, AttributeError) as error:
        raise InputError(
            f"the SigMF meta file is no JSON ({error})", expected="a whole file", cause="a cut download"
        ) from None
    warnings: list[str] = []
    counts: list[int] = []
    streams = [_track(captures, options, warnings, counts), *_levels(captures, options, warnings, counts)]
    if not any(stream is not None and stream.kind == "rss" for stream in streams):
        streams += _powers(meta, captures, options, warnings, counts)
    kept = tuple(stream for stream in streams if stream is not None)
    if not kept:
        raise InputError(
            "the SigMF meta file holds neither values nor positions, and its samples cannot be read",
            expected=f"measurement:values, core:rx_location, or {_data_name(options)!r} in the same folder",
        )
    count = max(counts)
    read_lines = np.unique(np.concatenate([stream.frame["line"].to_numpy() for stream in kept]))
    lost = np.setdiff1d(np.arange(1, count + 1), read_lines)
    rejected = tuple(RejectedLine(int(i), "a value without a time", "") for i in lost)
    return ReadResult(
        reader="sigmf",
        streams=kept,
        lines=count,
        accepted=len(read_lines),
        blank=0,
        rejected=rejected,
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _levels(
    captures: list[dict[str, Any]], options: ReadOptions, warnings: list[str], counts: list[int]
) -> list[Stream | None]:
    texts = _times(captures, "measurement:time_stamp", "core:datetime", "core:timestamp")
    made: list[Stream | None] = []
    for name, channel in _LEVELS.items():
        values = _column(captures, "measurement:values", name)
        if not len(values):
            continue
        if len(values) != len(texts):
            raise InputError(f"{len(values)} values of {name} and {len(texts)} times", expected="as many of each")
        unit = options.unit or "dB re full scale"
        level = {"rss_db": values}
        made.append(_stream("rss", channel, texts, level, options, warnings, counts, channel=channel, unit=unit))
    return made


def _track(
    captures: list[dict[str, Any]], options: ReadOptions, warnings: list[str], counts: list[int]
) -> Stream | None:
    """Positions: of the measurements, of the GPS, or of the receiver."""
    for field, times in (
        ("measurement:values", ("measurement:time_stamp", "core:datetime", "core:timestamp")),
        ("gps:position", ("gps:time_stamp", "core:datetime", "core:timestamp")),
        ("core:rx_location", ("core:timestamp", "core:datetime", "core:time")),
    ):
        texts = _times(captures, *times)
        values = {name: _column(captures, field, *names) for name, names in _PLACE}
        if not texts or len(values["latitude_deg"]) != len(texts) or len(values["longitude_deg"]) != len(texts):
            continue
        values = {name: column for name, column in values.items() if len(column) == len(texts)}
        for name, key in (("roll_deg", "roll"), ("pitch_deg", "pitch"), ("yaw_deg", "yaw")):
            column = _column(captures, "core:rotation", key)
            if len(column) == len(texts):
                values[name] = column
        return _stream("telemetry", "vehicle", texts, dict(values), options, warnings, counts, source=field)
    return None


def _data_name(options: ReadOptions) -> str:
    return options.file_name.removesuffix(".sigmf-meta") + ".sigmf-data"


def _powers(
    meta: dict[str, Any], captures: list[dict[str, Any]], options: ReadOptions, warnings: list[str], counts: list[int]
) -> list[Stream | None]:
    """Power of each burst of the samples beside the meta file."""
    common = _json.inside(meta, "global")
    data = options.beside(_data_name(options)) if options.beside else None
    kind = _SAMPLES.get(str(common.get("core:datatype", "")).split("_")[0])
    rate = _json.number(common.get("core:sample_rate"))
    if data is None or kind is None or not rate > 0:
        return []
    order = ">" if str(common.get("core:datatype")).endswith("_be") else "<"
    parts = 2 if str(common.get("core:datatype")).startswith("c") else 1
    channels = min(max(_whole(common.get("core:num_channels"), 1), 1), 64)
    frame_bytes = np.dtype(kind[0]).itemsize * parts * channels
    usable = len(data) // frame_bytes * frame_bytes
    samples = np.frombuffer(data[:usable], dtype=order + kind[0]).reshape(-1, channels, parts)
    size = max(1, round(BURST_S * rate))
    texts: list[str] = []
    powers: list[FloatArray] = []
    starts = [min(max(_whole(one.get("core:sample_start"), 0), 0), len(samples)) for one in captures]
    for i, capture in enumerate(captures):
        end = starts[i + 1] if i + 1 < len(starts) else len(samples)
        stamp = next(
            (str(capture[key]) for key in ("core:datetime", "core:timestamp", "core:time") if key in capture), None
        )
        if stamp is None:
            warnings.append("captures without core:datetime are left out")
            continue
        for at in range(starts[i], end - size // 2, size):
            piece = samples[at : min(at + size, end)].astype(np.float64) / kind[1]
            if len(piece):
                texts.append(_later(stamp, (at - starts[i]) / rate))
                with np.errstate(all="ignore"):  # damaged samples may be any number
                    powers.append((piece**2).sum(axis=2).mean(axis=0))
    if not texts:
        return []
    with np.errstate(all="ignore"):
        level = 10 * np.log10(np.array(powers))
    unit = options.unit or "dB re full scale"
    made: list[Stream | None] = []
    for i in range(channels):
        name, values = f"USRP{i + 1}", {"rss_db": level[:, i]}
        made.append(_stream("rss", name, texts, values, options, warnings, counts, channel=name, unit=unit))
    return made


def _whole(value: Any, default: int) -> int:
    number = _json.number(value)
    return int(number) if np.isfinite(number) and abs(number) < 2**53 else default


def _later(stamp: str, seconds: float) -> str:
    """A time so many seconds after another, in the form of the first."""
    try:
        return f"{float(stamp) + seconds:.6f}"
    except ValueError:
        zone = stamp[-1:] if stamp.endswith("Z") else ""
        if not _MOMENT.fullmatch(stamp):
            return "-"
        moment = np.datetime64(stamp.removesuffix("Z").replace(" ", "T"), "ns") + np.timedelta64(
            round(seconds * 1e9), "ns"
        )
        return str(moment) + zone


READER = Reader(
    name="sigmf",
    title="SigMF meta file: levels and positions (dataset 12, sounder), or power of the samples beside it",
    kinds=("rss", "telemetry"),
    sample='{"global": {"core:datatype": "cf32_le"}, "captures": [{"measurement:values": {"mX": [], "RSS1": []}}]}',
    sniff=sniff,
    read=read,
    pieces=True,
)
