"""Damaged inputs: each file gives a result that accounts for its lines, or one message of the package.

Mutated seeds are passed to every reader of the catalogue, and to the readers of flight.yaml, site.yaml, campaign.yaml,
map files, MATLAB files, flight files, antenna files, the path cache and elevation models. Seeds are the samples of the
tests, and pieces of a few lines of ``sample_logs`` and of ``$AERPAW_CMP_FIELD_DATA``. Each seed itself is accepted.

In two of three inputs one value of a seed is replaced, so that code behind the first check is tested, too. In the
others, bytes, lines, numbers (infinities, 1e30, -0, integers of forty digits), encodings and clocks change.

For each input, all lines must be accounted for, and only exceptions of the package may be raised. It may take at most
2 s of processor time and 300 MiB, and the process must survive. Input ``i`` of a target depends only on the seed, the
target and ``i``, so ``--reproduce TARGET I`` repeats a violation.

``--inputs 20000 --workers 2`` is the recorded run of docs/security.md, with about 1 300 s of processor time for all
readers. Each row is printed as soon as it is done, so the rows of an interrupted run are valid.
"""

import argparse
import fnmatch
import gc
import hashlib
import io
import json
import mmap
import multiprocessing
import os
import pickle
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from aerpaw_cmp.common import native
from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.logs import limits
from aerpaw_cmp.logs.files import whole_lines
from aerpaw_cmp.logs.readers import HEAD_BYTES, Reader, ReadOptions, catalogue
from aerpaw_cmp.logs.records import ReadResult

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 2.0
LIMIT_MIB = 300
# A worker that needs this processor time for one input hangs in native code, where no alarm reaches it.
WATCHDOG_S = 20.0
# One that finishes no input for so long sleeps for ever; long, so that a run may have the lowest priority.
WATCHDOG_WALL_S = 600.0

BLOCK = 1000
# Every n-th input is given to the sniffers of all readers.
SNIFF_EVERY = 32
# Every n-th input consists of several logs joined by hand.
JOINED_EVERY = 8
SEED_BYTES = 1500
MEDIUM_BYTES = 4000

FRAME = SiteFrame(35.7275, -78.696)
OPTIONS = (
    ReadOptions(
        timezone="America/New_York", time_origin="2025-03-02T15:00:00Z", kind="rss",
        columns={"time": "Time", "rss_db": "Level"}, unit="dBm", ri_base="one",
    ),
    ReadOptions(
        timezone="Europe/Berlin", clock="local_as_utc", kind="rank", ri_base="zero",
        columns={"time": "Time", "ri_raw": "Level"}, channel="c", node="LW1",
    ),
    ReadOptions(
        timezone="America/New_York", clock="utc", kind="telemetry",
        columns={"time": "Time", "latitude_deg": "Level", "longitude_deg": "Level", "altitude_m": "Level"},
    ),
)  # fmt: skip


class ViolationError(Exception):
    """The input broke a promise."""


@dataclass(frozen=True)
class Target:
    """A function that reads input. ``run`` returns whether it accepted the input, or raises an error of the package."""

    name: str
    seeds: tuple[bytes, ...]
    run: Callable[[bytes, int], bool]
    refuses: bool = False
    """True for a reader that only names files that are not logs."""


# --- mutations -------------------------------------------------------------------------------------------------------

NUMBERS = (
    b"inf", b"-inf", b"nan", b"1e30", b"-1e30", b"-0", b"-0.0", b"0", b"1", b"1e308", b"1e999", b"-1e-320", b"9" * 40,
    b"-" + b"9" * 40, b"9223372036854775807", b"9223372036854775808", b"-9223372036854775809", b"4294967296", b"65535",
    b"-32768", b"255", b"256", b"-1", b"0x10", b"1_000", b"1,5", b"0777", b"1e", b"+", b"", b"1e-9", b"360", b"90.0001",
    b"\xd9\xa1\xd9\xa2", b"5e8", b"true", b"null", b"~", b".inf", b".nan", b"1" * 5000,
)  # fmt: skip
WORDS = (
    b"", b"\0", b"\xff", b"\xfe\xff", b"\xef\xbb\xbf", b"\r", b"\n", b"\r\n", b"\n\n", b",", b";", b'"', b"'", b"[",
    b"]", b"{", b"}", b"(", b")", b"<", b">", b"&#0;", b"&lt;", b"%s", b"$", b"\\", b"*", b"&a", b"*a",
    b"!!python/object:os", b"\xe2\x80\xa8", b"\xc3", b"a" * 70_000, b"-" * 300, b"\t", b"\x1b[31m", b"NaN", b"=1+1",
    b": ", b"- ", b"#", b"PK\3\4", b"\x1f\x8b", b"\x89HDF\r\n\x1a\n", b"<<: *a", b"../../../etc/passwd",
)  # fmt: skip
DATES = (
    b"0000-00-00", b"0001-01-01", b"1677-09-21", b"1969-12-31", b"2262-04-12", b"9999-12-31", b"2025-02-30",
    b"2024-02-29", b"2025-13-01", b"2025-03-09", b"2025-11-02", b"10000-01-01", b"-001-01-01",
)  # fmt: skip
HOURS = (
    b"24:00:00", b"23:59:60", b"02:30:00", b"01:30:00", b"25:61:61", b"00:00:00", b"12:00", b"99:99:99", b"-1:00:00",
)  # fmt: skip
ENCODINGS = ("utf-16", "utf-16-le", "utf-32", "utf-7", "cp037", "utf-8-sig")

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_DATE = re.compile(rb"\d{4}-\d{2}-\d{2}")
_HOUR = re.compile(rb"\d{2}:\d{2}:\d{2}")


def _span(data: bytes, chance: np.random.Generator, most: int = 64) -> tuple[int, int]:
    start = int(chance.integers(0, len(data) + 1))
    return start, min(len(data), start + int(chance.integers(0, most)))


def _replace_one(
    pattern: re.Pattern[bytes], values: tuple[bytes, ...], data: bytes, chance: np.random.Generator
) -> bytes:
    start = int(chance.integers(0, len(data) + 1))
    match = pattern.search(data, start) or pattern.search(data)
    if match is None:
        return data
    return data[: match.start()] + values[int(chance.integers(len(values)))] + data[match.end() :]


def _bytes(data: bytes, chance: np.random.Generator) -> bytes:
    out = bytearray(data)
    for _ in range(int(chance.integers(1, 4))):
        if out:
            out[int(chance.integers(len(out)))] ^= int(chance.integers(1, 256))
    return bytes(out)


def _cut(data: bytes, chance: np.random.Generator) -> bytes:
    start, end = _span(data, chance)
    return data[:start] + data[end:]


def _truncate(data: bytes, chance: np.random.Generator) -> bytes:
    return data[: int(chance.integers(0, len(data) + 1))]


def _copy(data: bytes, chance: np.random.Generator) -> bytes:
    start, end = _span(data, chance, 400)
    at = int(chance.integers(0, len(data) + 1))
    return data[:at] + data[start:end] * int(chance.choice([1, 1, 2, 30])) + data[at:]


def _insert(data: bytes, chance: np.random.Generator) -> bytes:
    start, end = _span(data, chance, 8)
    return data[:start] + WORDS[int(chance.integers(len(WORDS)))] + data[end:]


def _number(data: bytes, chance: np.random.Generator) -> bytes:
    return _replace_one(_NUMBER, NUMBERS, data, chance)


def _clock(data: bytes, chance: np.random.Generator) -> bytes:
    if chance.random() < 0.5:
        return _replace_one(_DATE, DATES, data, chance)
    return _replace_one(_HOUR, HOURS, data, chance)


def _lines(data: bytes, chance: np.random.Generator) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) < 2:
        return data
    i, j = (int(k) for k in chance.integers(0, len(lines), 2))
    what = int(chance.integers(4))
    if what == 0:
        lines[i], lines[j] = lines[j], lines[i]
    elif what == 1:
        lines.insert(i, lines[j])
    elif what == 2:
        del lines[i]
    else:
        lines[i] = lines[i].rstrip(b"\r\n") + lines[j]
    return b"".join(lines)


def _encode(data: bytes, chance: np.random.Generator) -> bytes:
    what = int(chance.integers(6))
    if what == 0:
        return data.replace(b"\n", b"\r\n")
    if what == 1:
        return data.replace(b"\r\n", b"\n").replace(b"\n", b"\r")
    if what == 2:
        return b"\xef\xbb\xbf" + data
    if what == 3:
        return data.replace(b"\n", b"")
    text = data.decode("latin-1")
    return text.encode(ENCODINGS[int(chance.integers(len(ENCODINGS)))], errors="replace")


def _case(data: bytes, chance: np.random.Generator) -> bytes:
    start, end = _span(data, chance, 200)
    return data[:start] + data[start:end].swapcase() + data[end:]


# Values of a text: numbers and words, dates and names among them.
_VALUE = re.compile(rb"[-+]?\d[\d.eE+\-:/]*|[A-Za-z_][\w.]*")


def _near(value: bytes, chance: np.random.Generator) -> bytes:
    """A value that resembles a valid one: another digit or letter, the other sign, ten times as much."""
    at = int(chance.integers(len(value)))
    kind = int(chance.integers(4))
    if kind == 0 and value[:1].isdigit():
        return b"-" + value
    if kind == 1 and value[-1:].isdigit():
        return value + b"0"
    letter = b"%d" % chance.integers(10) if value[at : at + 1].isdigit() else b"abcxyz"[at % 6 : at % 6 + 1]
    return value[:at] + letter + value[at + 1 :]


def one_value(data: bytes, chance: np.random.Generator) -> bytes:
    """Return a file with one value replaced, half of the time by a similar value.

    In a binary file, one bit is flipped.
    """
    values = [] if b"\0" in data[:2000] else [match.span() for match in _VALUE.finditer(data)]
    if not values:
        at = int(chance.integers(len(data)))
        return data[:at] + bytes([data[at] ^ (1 << int(chance.integers(8)))]) + data[at + 1 :]
    start, stop = values[int(chance.integers(len(values)))]
    if chance.random() < 0.5:
        return data[:start] + _near(data[start:stop], chance) + data[stop:]
    hostile = NUMBERS if data[start:stop][-1:].isdigit() else (*NUMBERS, *WORDS)
    return data[:start] + hostile[int(chance.integers(len(hostile)))] + data[stop:]


MUTATIONS = (_bytes, _cut, _truncate, _copy, _insert, _number, _number, _number, _clock, _lines, _lines, _encode, _case)


def mutated(target: Target, seed: int, index: int) -> bytes:
    """Return input ``index`` of a target: a seed with one value replaced, or some seeds changed one to five times."""
    name = int.from_bytes(hashlib.sha256(target.name.encode()).digest()[:8], "big")
    chance = np.random.default_rng([seed, name, index])
    data = target.seeds[int(chance.integers(len(target.seeds)))]
    if index % 3:
        return one_value(data, chance)[:200_000]
    if index % JOINED_EVERY == 0:
        data += b"".join(target.seeds[i] for i in chance.integers(len(target.seeds), size=chance.integers(4)))
    if chance.random() < 0.05:
        other = target.seeds[int(chance.integers(len(target.seeds)))]
        data = data[: int(chance.integers(len(data) + 1))] + other[int(chance.integers(len(other) + 1)) :]
    for _ in range(int(chance.integers(1, 6))):
        data = MUTATIONS[int(chance.integers(len(MUTATIONS)))](data, chance)
    return data[:200_000]


# --- what must hold --------------------------------------------------------------------------------------------------


def check_law(result: ReadResult, data: bytes, binary: bool) -> None:
    """Check that a file's lines are accounted for, and that its frames have the promised columns."""
    if result.lines != result.accepted + result.rejected_count + result.blank:
        raise ViolationError("lines are not accepted + rejected + blank")
    if not binary and result.lines != data.count(b"\n") + (not data.endswith(b"\n") and len(data) > 0):
        raise ViolationError(f"{result.lines} lines counted, the file has {data.count(10)} line ends")
    numbers = [line.number for line in result.rejected]
    if numbers != sorted(set(numbers)):
        raise ViolationError("rejected lines are not in order, or come twice")
    if not all(line.reason and len(line.text) <= 500 for line in result.rejected):
        raise ViolationError("a rejected line without a reason, or with too long a text")
    if len({(stream.kind, stream.name) for stream in result.streams}) < len(result.streams):
        raise ViolationError("two streams of one name")
    records: set[int] = set()
    for stream in result.streams:
        records |= _check_frame(stream.name, stream.kind, stream.frame, max(result.lines, 1))
    if records & set(numbers):
        raise ViolationError("a rejected line gave a record")
    if len(records) > result.accepted:
        raise ViolationError("more lines gave records than were accepted")


RANGES = {name: bounds for ranges in limits.LIMITS.values() for name, bounds in ranges.items()}


def _check_frame(name: str, kind: str, frame: Any, lines: int) -> set[int]:
    """Check the promises of a stream's frame. Return the lines of its records."""
    time_, line = frame["time"].to_numpy(), frame["line"].to_numpy()
    if time_.dtype != np.dtype("datetime64[ns]") or np.isnat(time_).any():
        raise ViolationError(f"{name}: a record without a time")
    if len(line) and (line.min() < 1 or line.max() > lines):
        raise ViolationError(f"{name}: a record of no line")
    if not all(type(flag) is str for flag in frame["flag"].to_numpy()):
        raise ViolationError(f"{name}: a flag that is no text")
    if kind == "rank" and (frame["rank"].to_numpy() < 1).any():
        raise ViolationError(f"{name}: a rank below 1")
    if kind == "rss" and np.isinf(frame["rss_db"].to_numpy()).any():
        raise ViolationError(f"{name}: an infinite level")
    for column, series in frame.items():
        low, high = RANGES.get(column, (-np.inf, np.inf))
        if column in RANGES and ((values := series.to_numpy(dtype=float)) < low).any() | (values > high).any():
            raise ViolationError(f"{name}: {column} beyond its range")
    return set(line.tolist())


def _read_log(reader: Reader, binary: bool, data: bytes, index: int) -> bool:
    if index % SNIFF_EVERY == 0:
        head = data[:HEAD_BYTES]
        for candidate in catalogue():
            candidate.sniff(head)
    options = OPTIONS[index % len(OPTIONS)]
    if reader.name == "iq_burst":  # dated by its name
        options = replace(options, file_name="results_3320000000.0_2000000.0_2025_03_02_10_00_00_250.mat")
    result = limits.check(reader.read(data, options))
    check_law(result, data, binary)
    if reader.read_pieces is not None and not data.startswith(b"\xef\xbb\xbf"):  # ingest removes it
        _read_in_pieces(reader, data, options, result, (61, 400, 1200)[index % 3])
    return result.accepted > 0


def _read_in_pieces(reader: Reader, data: bytes, options: ReadOptions, at_once: ReadResult, size: int) -> None:
    """The same result from pieces of a few lines."""
    assert reader.read_pieces is not None
    pieces = whole_lines(data[i : i + size] for i in range(0, len(data), size))
    parts = limits.check(reader.read_pieces(pieces, options))
    for name in ("lines", "accepted", "blank", "rejected", "reasons", "warnings"):
        if getattr(parts, name) != getattr(at_once, name):
            raise ViolationError(f"{name}: otherwise in pieces of {size} bytes")
    for part, stream in zip(parts.streams, at_once.streams, strict=True):
        if (part.name, dict(part.attributes)) != (stream.name, dict(stream.attributes)) or not part.frame.equals(
            stream.frame
        ):
            raise ViolationError(f"{part.name}: otherwise in pieces of {size} bytes")


# --- targets ---------------------------------------------------------------------------------------------------------


def _pieces(data: bytes) -> Iterator[bytes]:
    """A few lines from the beginning of a log, and a few from its middle behind the first line."""
    yield data[:SEED_BYTES].rpartition(b"\n")[0] + b"\n" if len(data) > SEED_BYTES else data
    if len(data) > 4 * SEED_BYTES:
        middle = data.find(b"\n", len(data) // 2) + 1
        yield data[: data.find(b"\n") + 1][:500] + data[middle : data.find(b"\n", middle + 600) + 1]


def _small_mat(data: bytes) -> bytes:
    """A MATLAB 5 file with the first rows of each array."""
    import scipy.io

    from tests.parsers.samples import saved

    content = scipy.io.loadmat(io.BytesIO(data))
    arrays = {
        k: v[:6] if np.asarray(v).shape[0] > 6 else v[:, :6] for k, v in content.items() if not k.startswith("__")
    }
    return saved(arrays, compressed=len(data) % 2 == 0)


def _log_files() -> Iterator[Path]:
    roots = [ROOT / "sample_logs"]
    if field := os.environ.get("AERPAW_CMP_FIELD_DATA"):
        roots.append(Path(field))
    for root in roots:
        yield from sorted(p for p in root.rglob("*") if p.is_file() and p.stat().st_size < 40_000_000)


def _log_seeds() -> dict[str, list[bytes]]:
    """Pieces of real logs and of the samples, by the reader that knows them."""
    from tests.parsers.samples import NO_LOGS, SAMPLES, saved

    by_reader: dict[str, list[bytes]] = {r.name: [] for r in catalogue()}
    for name, samples in SAMPLES.items():
        by_reader[name] += [data for data, *_ in samples.values()]
    for name, data in NO_LOGS.items():
        by_reader[name].append(data)
    by_reader["antenna_grid"].append(saved({"rad_pat": np.zeros((3, 4))}))
    by_reader["matlab_other"].append(saved({"other": np.ones((2, 2))}))
    for path in _log_files():
        data = path.read_bytes()
        if data.startswith(b"\x1f\x8b"):
            import gzip

            data = gzip.decompress(data)
        readers = [r for r in catalogue() if r.sniff(data[:HEAD_BYTES])]
        if len(readers) != 1:
            continue
        if data.startswith(b"MATLAB 5"):
            try:
                by_reader[readers[0].name].append(_small_mat(data))
            except (ValueError, IndexError, TypeError, NotImplementedError):
                continue
        elif b"\0" not in data[:1000]:
            by_reader[readers[0].name] += [p for p in _pieces(data) if len(p) <= MEDIUM_BYTES]
    return {name: [s for s in dict.fromkeys(seeds) if len(s) <= 40_000] for name, seeds in by_reader.items() if seeds}


@contextmanager
def _file(data: bytes, name: str) -> Iterator[Path]:
    path = SCRATCH / f"{os.getpid()}-{name}"
    path.write_bytes(data)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


SCRATCH = Path("/dev/shm" if os.access("/dev/shm", os.W_OK) else tempfile.gettempdir())


def _by_path(name: str, read: Callable[[Path], Any], data: bytes, _index: int) -> bool:
    with _file(data, name) as path:
        return read(path) is not None


FLIGHT = b"""flight: {name: f, title: "A $", plan: {start: 2025-06-01T10:00:00, waypoints: [{label: A, east_m: 0,
  north_m: 0, height_m: 5}, {east_m: 90, north_m: 0, height_m: 30, hold_s: 2}], seed: 1}}
site: {file: lake_wheeler, without_buildings: true}
timezone: America/New_York
logs:
  - {path: a_vehicleOut.txt, reader: vehicle_out}
  - {path: b.txt, reader: sounder_log, node: LW1, channel: USRP1, clock: local, floor_db: -200, skip: [quality]}
link: {rss: {carrier_hz: 3.3e9, tower: {layout: linear, elements: 2, slant_deg: [45, -45], antenna: {model: dipole}}}}
rt: {engine: image, max_depth: 1, attitude: logged, foliage: attenuating}
rss: {span_db: [-50, 50], lag: apply}
rank: {tower: LW1, k: [10, 100]}
report: {waypoints: [{label: W, east_m: 1, north_m: 2, height_m: 3}]}
"""
CAMPAIGN = b"""campaign: c
title: "A campaign"
flights: [a.yaml, b.yaml]
settings:
  one: {}
  two: {rt.max_depth: 0, link.rss.uav.yaw_deg: 315}
"""


def _loader(module: str, name: str, **options: Any) -> Callable[[Path], Any]:
    """A reader of the package by its name, loaded by the process that reads."""
    return lambda path: getattr(import_module(f"aerpaw_cmp.{module}"), name)(path, **options)


def _flight(path: Path) -> bool:
    from aerpaw_cmp.flight.gains import load_with_learned
    from aerpaw_cmp.flight.simulate import plan_trajectory

    settings = load_with_learned(path)
    for link in (settings.link.rss, settings.link.rank, *settings.link.channels.values()):
        link.build(["LW1"], path.parent)
    for log in settings.logs:
        log.options(settings.timezone)
    if settings.flight.plan is not None:
        plan_trajectory(settings.flight.plan)
    return True


def _map(path: Path) -> Any:
    from aerpaw_cmp.site.footprints import import_footprints

    return import_footprints([path], FRAME)


def _dem(path: Path) -> Any:
    from aerpaw_cmp.site.relief import read_dem

    return read_dem(path, FRAME, crs="local" if path.suffix == ".asc" else None)


def _mat(data: bytes, _index: int) -> bool:
    from aerpaw_cmp.logs.matfile import read_arrays

    return bool(read_arrays(data, None))


def _gzipped(data: bytes, index: int) -> bool:
    import gzip

    from aerpaw_cmp.logs.ingest import read_file

    # two of three: a sound archive of a damaged log
    packed = gzip.compress(data, compresslevel=1, mtime=0)
    with _file(packed if index % 3 else packed[: -1 - index % 50], "log.gz") as path:
        return read_file(path, options=OPTIONS[index % len(OPTIONS)]).result.accepted > 0


def _path_cache(data: bytes, _index: int) -> bool:
    from aerpaw_cmp.propagation.engines import PathCache

    with _file(data, "key.npz") as path:
        return PathCache(path.parent).load(path.stem) is not None


def _cache_entry() -> bytes:
    from aerpaw_cmp.propagation.engines import PathCache
    from aerpaw_cmp.propagation.geometry import PathSet

    with tempfile.TemporaryDirectory() as folder:
        paths = PathSet(
            np.arange(4), np.zeros(4, np.int64), np.array([0, 1, 0, 1]), np.full((4, 1), -1), np.zeros((4, 1, 3))
        )
        PathCache(Path(folder)).save("key", paths, 1.0)
        return (Path(folder) / "key.npz").read_bytes()


def _flight_bytes(log: bytes) -> bytes:
    from aerpaw_cmp.logs.flight_file import IngestedFile, fill
    from aerpaw_cmp.logs.readers import identify

    stream = io.BytesIO()
    fill(stream, [IngestedFile("a.txt", "0" * 64, identify(log).read(log, OPTIONS[0]))])
    return stream.getvalue()


def _geotiff() -> bytes | None:
    try:
        import rasterio
        from rasterio.transform import from_origin
    except ImportError:
        return None
    with rasterio.MemoryFile() as memory:
        profile = {"driver": "GTiff", "height": 5, "width": 5, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
        with memory.open(**profile, transform=from_origin(-78.6985, 35.73, 0.001, 0.001)) as image:
            image.write(np.arange(25, dtype=np.float32).reshape(1, 5, 5))
        return bytes(memory.read())


def _zipped(name: str, data: bytes, kind: int) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", kind) as archive:
        archive.writestr(name, data)
    return packed.getvalue()


def targets() -> list[Target]:
    """Everything that reads a file, with its seeds."""
    from aerpaw_cmp.logs.flight_file import _SEAL
    from tests.site import test_mutilated_files as maps

    logs = _log_seeds()
    readers = {r.name: r for r in catalogue()}
    out = []
    for name, seeds in sorted(logs.items()):
        # SigMF is accounted for by its values, as binary files are, not by the lines of its JSON
        binary = name == "sigmf" or any(b"\0" in seed[:200] for seed in seeds)
        read = partial(_read_log, readers[name], binary)
        out.append(Target(f"reader:{name}", tuple(seeds), read, refuses=not readers[name].kinds))
    # a burst is dated by its name, which a packed file has lost
    reads = {name for name, reader in readers.items() if reader.kinds} - {"generic_csv", "iq_burst"}
    some = [seeds[0] for name, seeds in sorted(logs.items()) if name in reads]
    out.append(Target("ingest:gzip", tuple(some), _gzipped))
    mats = [s for seeds in logs.values() for s in seeds if s.startswith((b"MATLAB", b"\x89HDF"))]
    out.append(Target("matfile", tuple(mats), _mat))
    vehicle = next(iter(logs["vehicle_out"]))
    file = partial(_by_path, "f.h5", _loader("logs.flight_file", "read_flight"))
    sealed = _flight_bytes(vehicle)
    # without its seal, too: damage that the seal would find first
    out.append(Target("flight_file", (sealed, sealed[: sealed.rindex(_SEAL)]), file))
    out.append(Target("path_cache", (_cache_entry(),), _path_cache))
    sample = (ROOT / "sample_logs/flight.yaml").read_bytes()[:MEDIUM_BYTES]
    yamls: list[tuple[str, tuple[bytes, ...], Callable[[Path], Any]]] = [
        ("flight.yaml", (FLIGHT, sample), _flight),
        ("campaign.yaml", (CAMPAIGN,), _loader("jobs.campaign", "load_campaign")),
        ("site.yaml", (maps.SITE,), _loader("site.siteyaml", "load_site")),
    ]
    for name, seeds, load in yamls:
        out.append(Target(name, seeds, partial(_by_path, name, load)))
    fence = [p.read_bytes() for p in _log_files() if p.name.endswith("Geofence.kml")]
    plain = {"geojson": (maps.GEOJSON,), "overpass": (maps.OVERPASS,), "osm": (maps.OSM,)}
    for name, seeds in {**plain, "kml": (maps.KML, *(f[:MEDIUM_BYTES] for f in fence))}.items():
        out.append(Target(f"map:{name}", seeds, partial(_by_path, f"m.{name}", _map)))
    kinds = (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
    kmz = tuple(_zipped("doc.kml", maps.KML, kind) for kind in kinds)
    out.append(Target("map:kmz", kmz, partial(_by_path, "m.kmz", _map)))
    out.append(Target("dem:asc", (maps.DEM,), partial(_by_path, "d.asc", _dem)))
    if (tiff := _geotiff()) is not None:
        out.append(Target("dem:tif", (tiff,), partial(_by_path, "d.tif", _dem)))
    pattern = partial(_by_path, "p.txt", _loader("site.antennas", "read_pattern_text"))
    out.append(Target("antenna:text", (maps.PATTERN,), pattern))
    for name, (seed, load) in SMALL_FILES.items():
        out.append(Target(name, (seed,), partial(_by_path, name.replace(":", "."), load)))
    return out


def _scene(path: Path) -> Any:
    from aerpaw_cmp.site.mitsuba import read_scene

    (path.parent / "mesh.ply").write_bytes(PLY)
    return read_scene(path)


def _report(path: Path) -> Any:
    """Return the differences of a report from itself. Its tables have no rows."""
    from aerpaw_cmp.jobs.diff_reports import run_diff
    from aerpaw_cmp.report.columns import RANK, RSS, header

    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        path.rename(Path(folder) / "metrics.json")
        for name, columns in (("rss.csv", header(RSS)), ("rank.csv", header(RANK))):
            (Path(folder) / name).write_text(",".join(columns) + "\n", encoding="utf-8")
        return run_diff(Path(folder), Path(folder))


def _receiver_file() -> bytes:
    """The packaged rank receiver with two of its twenty members."""
    import gzip

    folder = ROOT / "aerpaw_cmp" / "site" / "data" / "lake_wheeler.learned"
    content = json.loads(gzip.decompress(next(folder.glob("*.receiver.json.gz")).read_bytes()))
    for tower in content["towers"].values():
        tower |= {name: tower[name][:2] for name in ("geometries", "members")}
    return json.dumps(content).encode()


_VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()
PLY = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uint int vertex_indices\nend_header\n" + _VERTICES + struct.pack("<I3i", 3, 0, 1, 2)
)
PLAN = json.dumps({
    "fileType": "Plan", "mission": {"firmwareType": 3, "plannedHomePosition": [35.7275, -78.696, 100], "items": [
        {"command": 16, "frame": 3, "params": [0, 0, 0, None, 35.7275, -78.696, 40], "type": "SimpleItem"},
        {"command": 16, "frame": 3, "params": [0, 0, 0, None, 35.7285, -78.697, 40], "type": "SimpleItem"},
    ]},
}).encode()  # fmt: skip
FENCE = (
    b"<kml><Placemark><Polygon><outerBoundaryIs><LinearRing><coordinates>-78.69,35.72,0 -78.68,35.72,0 "
    b"-78.68,35.73,0</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></kml>"
)
SCENE = (
    b'<scene version="2.1.0"><bsdf type="itu-radio-material" id="w"><string name="type" value="concrete"/></bsdf>'
    b'<shape type="ply"><string name="filename" value="mesh.ply"/><ref id="w"/></shape></scene>'
)
SPHERE = b"azimuth_deg,elevation_deg,gain_dbi\n" + b"".join(
    b"%d,%d,0.0\n" % (a, e) for a in range(0, 360, 60) for e in range(-90, 91, 30)
)
REPORT = json.dumps({
    "flight": "f", "rss": {"LW1": {"U": {"offset_db": 1.5, "rmse_db": 2.5, "n": 200}}}, "rank": {}, "settings": {},
    "inputs": [{"path": "a.txt", "sha256": "0" * 64, "reader": "sounder_log"}], "rt": {}, "versions": {},
}).encode()  # fmt: skip
WAYPOINT = b"%d\t0\t%d\t16\t0\t0\t0\t0\t35.7275\t-78.696\t100\t1\n"
_ROUTE = _loader("flight.route_files", "read_route", height_m=40.0)
# Files of one seed each: inputs other than logs and maps that may come from a third party.
SMALL_FILES: dict[str, tuple[bytes, Callable[[Path], Any]]] = {
    "route:csv": (b"latitude,longitude,altitude\n35.7275,-78.696,40\n35.7285,-78.697,40\n", _ROUTE),
    "route:plan": (PLAN, _ROUTE),
    "route:wpl": (b"QGC WPL 110\n" + WAYPOINT % (0, 0) + WAYPOINT % (1, 3), _ROUTE),
    "fence:kml": (FENCE, _loader("flight.route_files", "read_areas")),
    "mesh:ply": (PLY, _loader("site.mitsuba", "read_mesh")),
    "scene:xml": (SCENE, _scene),
    "sphere:csv": (SPHERE, _loader("site.learned", "read_sphere_csv")),
    "receiver:json": (_receiver_file(), _loader("jobs.calibrate_rank", "read_receiver")),
    "report:json": (REPORT, _report),
}


def _in_a_fork(kind: str, data: bytes) -> tuple[int, bytes, bytes]:
    """``native._in_child`` with the same child, forked in place of started: a new interpreter costs 0.3 s an input."""
    reader = _native_reader(kind)
    with tempfile.TemporaryFile() as said:
        process = os.fork()
        if process == 0:
            try:
                native.give_up_rights()
                pickle.dump(native.answer(reader, data), said)
                said.flush()
            finally:
                os._exit(1)
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
        said.seek(0)
        with suppress(EOFError):
            return pickle.load(said)
        return code, b"", b""


@cache
def _native_reader(kind: str) -> native.Read:
    return native.READERS[kind]()


# --- one input -------------------------------------------------------------------------------------------------------


class TimeIsUpError(BaseException):
    """The alarm, which no ``except Exception`` of the package may catch."""


def _alarm(_signal: int, _frame: Any) -> None:
    raise TimeIsUpError


def _room() -> int:
    """Address space of this process now [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def one_input(target: Target, seed: int, index: int, *, bounded: bool = True) -> tuple[str, str, float]:
    """Verdict (``read``, ``refused``, ``violation``), what it was, and seconds."""
    data = mutated(target, seed, index)
    if bounded:
        resource.setrlimit(resource.RLIMIT_AS, (_room() + LIMIT_MIB * 2**20, resource.RLIM_INFINITY))
        signal.signal(signal.SIGPROF, _alarm)
        signal.setitimer(signal.ITIMER_PROF, LIMIT_S)  # in processor time, because the machine may be shared
    start = time.process_time()
    try:
        took = target.run(data, index)
        verdict, what = ("read" if took else "refused"), ""
    except AerpawCmpError as error:
        verdict, what = "refused", ""
        if not all(c.isprintable() or c == "\n" for c in str(error)) or not str(error).strip():
            verdict, what = "violation", f"no message, or one with control characters: {str(error)[:200]!r}"
    except TimeIsUpError:
        verdict, what = "violation", f"more than {LIMIT_S:g} s"
    except MemoryError:
        verdict, what = "violation", f"more than {LIMIT_MIB} MiB"
    except Exception as error:  # that is the question
        verdict, what = "violation", f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        seconds = time.process_time() - start
        if bounded:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    return verdict, what, seconds


# --- blocks in worker processes --------------------------------------------------------------------------------------


def _block(target: Target, seed: int, start: int, stop: int, place: mmap.mmap, send: Any) -> None:
    warnings.simplefilter("ignore")
    sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123 - native libraries talk there
    native._in_child = _in_a_fork
    for kind in native.READERS:
        with suppress(ImportError):
            _native_reader(kind)
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    counts = {"read": 0, "refused": 0, "violation": 0}
    violations: list[dict[str, Any]] = []
    slowest, seconds = 0.0, 0.0
    for index in range(start, stop):
        place[:8] = struct.pack("q", index)
        verdict, what, took = one_input(target, seed, index)
        counts[verdict] += 1
        slowest, seconds = max(slowest, took), seconds + took
        if verdict == "violation":
            violations.append({"index": index, "what": what})
    send.send({**counts, "violations": violations[:20], "slowest_ms": round(1e3 * slowest, 1), "reading_s": seconds})
    send.close()


def _processor_s(pid: int | None) -> float:
    """Return the processor time of a process [s]. 0 if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run_block(target: Target, seed: int, start: int, stop: int) -> dict[str, Any]:
    """Run inputs ``start`` to ``stop`` in a separate process.

    If the process ends or hangs, the current input is the cause.
    """
    parts: list[dict[str, Any]] = []
    context = multiprocessing.get_context("fork")
    while start < stop:
        place = mmap.mmap(-1, 8)
        place[:8] = struct.pack("q", start)
        receive, send = context.Pipe(duplex=False)
        worker = context.Process(target=_block, args=(target, seed, start, stop, place, send))
        worker.start()
        send.close()
        at, since, spent = start, time.monotonic(), _processor_s(worker.pid)
        while not receive.poll(0.2) and worker.is_alive():
            (now,) = struct.unpack("q", place[:8])
            if now != at:
                at, since, spent = now, time.monotonic(), _processor_s(worker.pid)
            elif _processor_s(worker.pid) - spent > WATCHDOG_S or time.monotonic() - since > WATCHDOG_WALL_S:
                worker.kill()
        try:
            parts.append(receive.recv())
            worker.join()
            break
        except EOFError:
            worker.join()
            (at,) = struct.unpack("q", place[:8])
            violation = {"index": at, "what": f"the process ended with {worker.exitcode}"}
            # the account of the inputs before it went with the process: they are run again, up to the bad one
            if at > start:
                parts.append(run_block(target, seed, start, at))
            parts.append(
                {"read": 0, "refused": 0, "violation": 1, "violations": [violation], "slowest_ms": 0, "reading_s": 0}
            )
            start = at + 1
    return {
        **{key: sum(p[key] for p in parts) for key in ("read", "refused", "violation", "reading_s")},
        "violations": [v for p in parts for v in p["violations"]],
        "slowest_ms": max((p["slowest_ms"] for p in parts), default=0.0),
    }


def run(chosen: Iterable[Target], inputs: int, seed: int, tell: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """A row per target, as soon as it is done: inputs, read, refused, violations, the slowest, seconds of reading."""
    for target in chosen:
        row: dict[str, Any] = {"target": target.name, "inputs": inputs, "read": 0, "refused": 0, "violation": 0}
        row |= {"reading_s": 0.0, "slowest_ms": 0.0}
        for start in range(0, inputs, BLOCK):
            block = run_block(target, seed, start, min(inputs, start + BLOCK))
            for key in ("read", "refused", "violation", "reading_s"):
                row[key] += block[key]
            row["slowest_ms"] = max(row["slowest_ms"], block["slowest_ms"])
            for violation in block["violations"]:
                tell(f"{target.name} {violation['index']}: {violation['what']}")
        yield row


def side_by_side(parts: Iterable[Iterator[dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    """Rows of several runs, each in a process of its own, as they come."""
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()

    def put(rows: Iterator[dict[str, Any]]) -> None:
        for row in chain(rows, [None]):
            queue.put(row)

    workers = [context.Process(target=put, args=(part,)) for part in parts]
    for worker in workers:
        worker.start()
    for _ in workers:
        yield from iter(queue.get, None)
    for worker in workers:
        worker.join()


def main(argv: list[str] | None = None) -> list[dict[str, Any]]:
    """Mutate, read, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1000, help="per target; the recorded run: 20000")
    parser.add_argument("--target", default="*", help="pattern of target names, e.g. 'reader:*'")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes that share the targets")
    parser.add_argument("--reproduce", nargs=2, metavar=("TARGET", "I"), help="run one input here, with its traceback")
    parser.add_argument("--save", type=Path, help="with --reproduce: write the input to this file")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    known = {t.name: t for t in targets()}
    if arguments.reproduce:
        target, index = known[arguments.reproduce[0]], int(arguments.reproduce[1])
        data = mutated(target, arguments.seed, index)
        if arguments.save:
            arguments.save.write_bytes(data)
        print(f"{len(data)} bytes: {data[:2000]!r}")
        print(target.run(data, index))
        return []
    chosen = [t for name, t in known.items() if fnmatch.fnmatchcase(name, arguments.target)]
    start, rows = time.perf_counter(), []
    heads = ("inputs", "read", "refused", "violation", "slowest_ms", "ms/input")
    if not arguments.json:
        print(f"{'target':26} " + " ".join(f"{head:>10}" for head in heads))
    tell = partial(print, file=sys.stderr)
    parts = [
        run(chosen[k :: arguments.workers], arguments.inputs, arguments.seed, tell) for k in range(arguments.workers)
    ]
    for row in side_by_side(parts) if len(parts) > 1 else parts[0]:
        rows.append(row)
        if not arguments.json:  # each row at once: what an interrupted run has done counts
            numbers = (*(row[key] for key in heads[:-1]), round(1e3 * row["reading_s"] / row["inputs"], 2))
            print(f"{row['target']:26} " + " ".join(f"{number:10}" for number in numbers), flush=True)
    if arguments.json:
        print(json.dumps({"rows": rows, "seconds": round(time.perf_counter() - start, 1)}))
    if any(row["violation"] for row in rows):
        sys.exit(1)
    return rows


if __name__ == "__main__":
    main()
