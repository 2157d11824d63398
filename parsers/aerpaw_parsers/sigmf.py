"""SigMF: the flights in the meta files of dataset 12, positions of a sounder, or the power of samples.

Dataset 12 (``captures[]``) has ``measurement:values`` {mX, mY, mZ, RSS1, RSS2} with ``measurement:time_stamp``, and
``gps:position`` {x, y, z} with ``gps:time_stamp``. x is the longitude, y the latitude, z the height above take-off, and
RSS is in dB re full scale. A value is a list (a flight) or a number (a burst). A capture without a field uses the
global field of the same name. A sounder has ``core:timestamp`` (epoch), ``core:rx_location``, ``core:rotation``,
``core:velocity`` and ``core:frequency``; SigMF 1.x has ``core:geolocation`` per capture, above the ellipsoid.

Each frequency has a series. Header bytes (``core:header_bytes``) are not samples, and unsigned samples count from the
middle of their range. Without values, levels are the power of each 20 ms of samples in the ``.sigmf-data`` of the same
folder: 10 log10 of the mean of abs(x)^2 in dB re full scale of the data type. Clipped samples and a DC part are
reported. In the account of the file, each value counts as a line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from aerpaw_cmp.common.units import AnyArray, FloatArray
from aerpaw_cmp.readers import InputError, Reader, ReadOptions, ReadResult, RejectedLine, Rows, Stream, built, split

from . import _json, _pose, _stamps

_BURST_S = 0.02
# Part of full scale at which a value is clipped, and the share of such values that is reported.
_FULL, _CLIPPED_SHARE = 0.999, 1e-3
# A DC part this far above the rest of the power determines the level [dB]. A weaker DC part may be the carrier of the
# signal.
_DC_DB = 10.0
# Complex or real, float or integer, and the bits of a number.
_DATATYPE = re.compile(r"([cr])(f(?=32|64)|[iu](?=8|16|32))(8|16|32|64)(?:_[lb]e)?")
_TIMES = ("core:datetime", "core:timestamp", "core:time")
_LEVELS = {"RSS1": "USRP1", "RSS2": "USRP2", "RSS": "USRP1", "rss1": "USRP1", "rss2": "USRP2"}
_PLACE = (("latitude_deg", ("mY", "y", "latitude", "lat")), ("longitude_deg", ("mX", "x", "longitude", "lon")),
          ("altitude_m", ("mZ", "z", "altitude", "alt")))  # fmt: skip


def sniff(head: bytes) -> bool:
    """Check whether a file is JSON with SigMF's three parts. The global part usually comes first."""
    text = head.lstrip(b"\xef\xbb\xbf \r\n\t")
    return text[:1] == b"{" and b'"core:datatype"' in head and (b'"captures"' in head or b'"global"' in head)


def _list(value: Any) -> list[Any]:
    if isinstance(value, list):
        return value
    return [] if value is None else [value]


def _merged(meta: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the captures, each completed with the global fields that it does not have."""
    common = {key: value for key, value in _json.inside(meta, "global").items() if ":" in key}
    captures = _json.listed(meta, "captures")
    for capture in captures:
        # a global position is the position of a receiver on the ground, not a track
        point = [*_list(_json.inside(capture, "core:geolocation").get("coordinates")), None, None]
        capture |= {"geolocation": dict(zip("xyz", point, strict=False))} if point[0] is not None else {}
    return [{**common, **capture} for capture in captures] or [common]


def _column(captures: list[dict[str, Any]], field: str, *names: str) -> FloatArray:
    """Return a quantity of all captures as one array."""
    out: list[float] = []
    for capture in captures:
        place = _json.inside(capture, field)
        values = next((place[name] for name in names if name in place), None)
        out += [_json.number(value) for value in _list(values)]
    return np.array(out, dtype=np.float64)


def _times(captures: list[dict[str, Any]], own: str) -> list[str]:
    """Return the times of all captures, from the given field or from the core fields."""
    stamps = (next((capture[field] for field in (own, *_TIMES) if field in capture), None) for capture in captures)
    return [str(item) for stamp in stamps for item in _list(stamp)]


def _rows_of(texts: list[str], options: ReadOptions) -> Rows:
    """Return the values with times as rows, which are the lines of the account."""
    clock, cells, warnings = _stamps.read(texts, options)
    rows = built(
        split(b"\n" * len(texts)), np.arange(len(texts)), {"time": cells}, options, reader="sigmf", clock=clock
    )  # fmt: skip
    rows.warnings += warnings
    rows.clock_from = None  # the catalogue names the source
    return rows


def _at_frequencies(rows: Rows, channel: str, values: FloatArray, frequency_hz: FloatArray) -> Iterator[Stream]:
    """Yield the levels of a channel, one series per frequency of the captures."""
    level, flag = rows.level(np.where(np.isfinite(values), values, np.nan)[rows.at])
    unit, tuned_hz = rows.options.unit or "dB re full scale", frequency_hz[rows.at]
    known = np.unique(tuned_hz[np.isfinite(tuned_hz)]).tolist()
    for carrier_hz in known if len(known) > 1 else [known[0] if known else np.nan]:
        name = channel if len(known) < 2 else f"{channel}_{carrier_hz / 1e6:g}MHz"
        where = tuned_hz == carrier_hz if len(known) > 1 else None
        stream = rows.stream(
            "rss", name, {"rss_db": level}, where=where, flag=flag, channel=name, unit=unit,
            frequency_hz=rows.options.frequency_hz or (carrier_hz if np.isfinite(carrier_hz) else None),
        )  # fmt: skip
        if stream is not None:
            yield stream


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return levels per channel and the track, from the meta file or from the samples in its folder.

    Raises
    ------
    InputError
        If the file is not JSON, or has neither values, positions nor samples.
    """
    try:
        meta = json.loads(data.decode("utf-8-sig", "replace"))
        captures = _merged(meta)
    except (ValueError, RecursionError, AttributeError) as error:
        found = f"the SigMF meta file is not JSON ({error})"
        raise InputError(found, expected="a complete file", cause="a truncated download") from None
    tables = [*_track(captures, options), *_levels(captures, options)]
    warnings: list[str] = []
    if not any(stream.kind == "rss" for _, stream in tables):
        tables += _powers(meta, captures, options, warnings)
    if not tables:
        raise InputError(
            "the SigMF meta file has neither values nor positions, and its samples cannot be read",
            expected=f"measurement:values, core:rx_location, or {_data_name(options)!r} in the same folder",
            cause="".join(dict.fromkeys(warnings)),
        )
    count = max(rows.lines for rows, _ in tables)
    read_lines = np.unique(np.concatenate([rows.row for rows, _ in tables])) + 1
    lost = np.setdiff1d(np.arange(1, count + 1), read_lines)
    warnings = [*(text for rows, _ in tables for text in rows.warnings), *warnings]
    return ReadResult(
        reader="sigmf", streams=tuple(stream for _, stream in tables), lines=count, accepted=len(read_lines), blank=0,
        rejected=tuple(RejectedLine(int(i), "a value without a time", "") for i in lost),
        warnings=tuple(dict.fromkeys(warnings)),
    )  # fmt: skip


def _levels(captures: list[dict[str, Any]], options: ReadOptions) -> Iterator[tuple[Rows, Stream]]:
    texts = _times(captures, "measurement:time_stamp")
    for name, channel in _LEVELS.items():
        values = _column(captures, "measurement:values", name)
        if not len(values):
            continue
        if len(values) != len(texts):
            raise InputError(f"{len(values)} values of {name} and {len(texts)} times", expected="one time per value")
        rows = _rows_of(texts, options)
        counts = [len(_list(_json.inside(capture, "measurement:values").get(name))) for capture in captures]
        tuned = [_json.number(capture.get("core:frequency")) for capture in captures]
        for stream in _at_frequencies(rows, channel, values, np.repeat(tuned, counts)):
            yield rows, stream


def _track(captures: list[dict[str, Any]], options: ReadOptions) -> Iterator[tuple[Rows, Stream]]:
    """Yield the positions of the measurements, of the GPS, or of the receiver."""
    fields = ("measurement:values", "measurement:time_stamp"), ("gps:position", "gps:time_stamp")
    for field, time in (*fields, ("core:rx_location", "core:timestamp"), ("geolocation", "core:datetime")):
        texts = _times(captures, time)
        columns = {name: _column(captures, field, *names) for name, names in _PLACE}
        if not texts or len(columns["latitude_deg"]) != len(texts) or len(columns["longitude_deg"]) != len(texts):
            continue
        columns |= {name: _column(captures, "core:rotation", name.removesuffix("_deg")) for name in _pose.ANGLES}
        rows = _rows_of(texts, options)
        values: dict[str, AnyArray] = {k: column[rows.at] for k, column in columns.items() if len(column) == len(texts)}
        about: _pose.Height = {}
        if field == "geolocation":
            rows.height_from = "written"
            values["altitude_m"], about = _pose.above_takeoff(rows, values, "ellipsoid", _pose.clean(rows, values))
        if (stream := rows.stream("telemetry", "vehicle", values, source=field, about=about)) is not None:
            yield rows, stream
        return


def _data_name(options: ReadOptions) -> str:
    return options.file_name.removesuffix(".sigmf-meta") + ".sigmf-data"


def _powers(
    meta: dict[str, Any], captures: list[dict[str, Any]], options: ReadOptions, warnings: list[str]
) -> Iterator[tuple[Rows, Stream]]:
    """Yield the power of each burst of samples. ``captures`` include the global fields."""
    common = _json.inside(meta, "global")
    samples, full_scale = _samples(common, _json.listed(meta, "captures"), options)
    rate = _json.number(common.get("core:sample_rate"))
    # without a rate the number of samples in 20 ms is unknown
    if samples is None or not rate > 0:
        return
    size, zero = max(1, round(_BURST_S * rate)), _integer(common.get("core:offset"))
    # zero is between the two middle codes, such as 127.5 for codes 0 to 255
    middle = full_scale - 0.5 if samples.dtype.kind == "u" else 0.0
    # stamp of the capture, seconds after it, frequency, and per channel power, mean and share of clipped values
    bursts: list[tuple[str, float, float, FloatArray, FloatArray, FloatArray]] = []
    starts = [min(max(_integer(item.get("core:sample_start")) - zero, 0), len(samples)) for item in captures]
    for capture, start, end in zip(captures, starts, [*starts[1:], len(samples)], strict=True):
        stamp = next((capture[key] for key in _TIMES if key in capture), None)
        if stamp is None:
            warnings.append("captures without core:datetime have no time and are not read")
            continue
        # the end of a capture is not read if it is shorter than half a burst
        for at in range(start, end - size // 2, size):
            piece = samples[at : min(at + size, end)].astype(np.float64) - middle
            with np.errstate(all="ignore"):  # damaged samples may be any number
                power, size_of = (piece**2).sum(axis=2).mean(axis=0), np.abs(piece)
                # floats far above full scale are not clipped, but have an unknown scale
                clipped = (size_of >= _FULL * full_scale - 1.0 * (full_scale > 1)) & (size_of <= 1.001 * full_scale)
                about = power, piece.mean(axis=0), clipped.mean(axis=(0, 2))
            bursts.append((str(stamp), (at - start) / rate, _json.number(capture.get("core:frequency")), *about))
    if not bursts:
        return
    stamps, later_s, tuned, powers, means, shares = zip(*bursts, strict=True)
    with np.errstate(all="ignore"):
        level = 10 * np.log10(np.array(powers)) - 20 * np.log10(full_scale)
        dc = (np.mean(means, axis=0) ** 2).sum(axis=1)
        above_db = 10 * np.log10(dc / np.maximum(np.mean(powers, axis=0) - dc, 1e-12 * dc))
    for i, (share, dc_db) in enumerate(zip(np.mean(shares, axis=0), above_db, strict=True)):
        if share > _CLIPPED_SHARE:
            warnings.append(f"USRP{i + 1}: {share:.1%} of the values are at full scale: clipped, levels are too low")
        if dc_db > _DC_DB:
            reason = "the receiver's own offset, or a carrier at the centre frequency"
            warnings.append(f"USRP{i + 1}: levels are dominated by a DC part {dc_db:.0f} dB above the rest ({reason})")
    rows = _rows_of(list(stamps), options)
    rows.time = rows.time + np.round(np.array(later_s)[rows.at] * 1e9).astype("timedelta64[ns]")
    for i in range(level.shape[1]):
        for stream in _at_frequencies(rows, f"USRP{i + 1}", level[:, i], np.array(tuned)):
            yield rows, stream


def _samples(
    common: dict[str, Any], captures: list[dict[str, Any]], options: ReadOptions
) -> tuple[AnyArray | None, float]:
    """Return the stored samples, shape (n, channels, 1 or 2), or None, and the full scale of their type."""
    kind = _DATATYPE.fullmatch(str(common.get("core:datatype", "")))
    data = options.neighbour(_data_name(options)) if options.neighbour else None
    if data is None or kind is None:
        return None, 1.0
    stored = np.dtype(f"{'>' if kind[0].endswith('_be') else '<'}{kind[2]}{int(kind[3]) // 8}")
    full_scale = 1.0 if kind[2] == "f" else 2.0 ** (int(kind[3]) - 1)
    shape = (min(max(_integer(common.get("core:num_channels")), 1), 64), 2 if kind[1] == "c" else 1)
    frame_bytes = stored.itemsize * shape[0] * shape[1]
    data = data[: len(data) - max(_integer(common.get("core:trailing_bytes")), 0)]
    for capture in sorted(captures, key=lambda item: _integer(item.get("core:sample_start"))):
        begin = _integer(capture.get("core:sample_start")) * frame_bytes
        data = data[:begin] + data[begin + max(_integer(capture.get("core:header_bytes")), 0) :]
    return np.frombuffer(data[: len(data) // frame_bytes * frame_bytes], dtype=stored).reshape(-1, *shape), full_scale


def _integer(value: Any) -> int:
    number = _json.number(value)
    return int(number) if np.isfinite(number) and abs(number) < 2**53 else 0


READER = Reader(
    name="sigmf",
    title="SigMF meta file: levels and positions (dataset 12, sounder), or power of its samples",
    kinds=("rss", "telemetry"),
    sample='{"global": {"core:datatype": "cf32_le"}, "captures": [{"measurement:values": {"mX": [], "RSS1": []}}]}',
    sniff=sniff, read=read, pieces=True,
)  # fmt: skip
