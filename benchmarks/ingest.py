"""Measure time and peak memory of reading a large log, compared with pandas on the same file.

    python benchmarks/ingest.py [--scale LINES] [--format READER ...] [--folder DIR]

Every contestant is a process of its own. Ours gives UTC times, values and flags with every line accounted for; the
peer gives columns with their times converted.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from aerpaw_cmp.common.stages import peak_mib
from aerpaw_cmp.logs.flight_file import write_flight
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.writers import format_vehicle_out

ZONE = "America/New_York"
SCALE_LINES = 5_000_000
START = np.datetime64("2025-03-02T15:00:00", "ns")
STEP = 250_000


def _blocks(lines: int) -> Iterator[tuple[int, int]]:
    """First line and number of lines, some at a time."""
    for first in range(0, lines, STEP):
        yield first, min(STEP, lines - first)


def _wall(first: int, count: int, step_ns: int) -> np.ndarray:  # type: ignore[type-arg]
    """Local times of some lines as bytes, to the microsecond."""
    times = START - np.timedelta64(5, "h") + (first + np.arange(count)) * np.timedelta64(step_ns, "ns")
    text = np.datetime_as_string(times, unit="us").astype("S26")
    text.view(np.uint8).reshape(count, 26)[:, 10] = 32
    return text


def write_sounder(place: Path, lines: int) -> None:
    """Write a power log with consecutive octal offsets."""
    values = [b"%16.6f" % value for value in np.random.default_rng(5).normal(-40, 9, STEP)]
    with place.open("wb") as file:
        for first, count in _blocks(lines):
            times = _wall(first, count, 3_276_000).tolist()
            rows = zip(times, range(first, first + count), values, strict=False)
            file.writelines(b"[%s] %07o%s\n" % (time, 4 * i, value) for time, i, value in rows)


def write_vehicle(place: Path, lines: int) -> None:
    """Write telemetry of ten fields with a consecutive index."""
    rng = np.random.default_rng(6)
    names = ("altitude_m", "roll_deg", "pitch_deg", "yaw_deg", "velocity_north_mps", "velocity_east_mps")
    track = pd.DataFrame({name: rng.uniform(-9, 9, STEP) for name in names}).assign(time=START)
    track = track.assign(latitude_deg=35.73 + track["roll_deg"] / 1e3, longitude_deg=-78.7)
    track = track.assign(velocity_down_mps=0.5, fix=4, satellites=20)
    made = format_vehicle_out(track, ZONE).splitlines(keepends=True)
    stamp = b"2025-03-02 10:00:00.000000"
    parts = [line.partition(b",")[2].partition(stamp)[::2] for line in made]
    with place.open("wb") as file:
        for first, count in _blocks(lines):
            rows = zip(_wall(first, count, 5_000_000).tolist(), range(first, first + count), parts, strict=False)
            file.writelines(b"%d,%s%s%s" % (i, before, time, after) for time, i, (before, after) in rows)


def write_quectel(place: Path, lines: int) -> None:
    """CSI rows of the launched logger."""
    rng = np.random.default_rng(7)
    with place.open("wb") as file:
        for first, count in _blocks(lines):
            rows = zip(_wall(first, count, 10_000_000).tolist(), rng.integers(1, 5, count).tolist(), strict=True)
            file.writelines(
                b'%s,"+QNWCFG: ""lte_csi""",20,1,9,3,"+QNWCFG: ""nr5g_csi""",27,%d,15,3\r\n' % (time[:-3], rank)
                for time, rank in rows
            )


def write_drive_test(place: Path, lines: int) -> None:
    """A phone's log as G-NetTrack writes it, of eight cells: a neighbour in one row of two."""
    rng = np.random.default_rng(12)
    with place.open("wb") as file:
        file.write(b"Timestamp,Longitude,Latitude,Speed,CellID,LTEPCI,RSRP,RSRQ,SNR,CQI,NRxRSRP\n")
        for first, count in _blocks(lines):
            level = rng.integers(-115, -60, count).tolist()
            rows = zip(_wall(first, count, 500_000_000).tolist(), range(first, first + count), level, strict=True)
            file.writelines(
                b"%s,-78.70%05d,35.73%05d,%d,11,%d,%d,%d,%d,9,%s\n" % (
                    time, n % 99989, n % 99991, n % 7, n // 50 % 8, rsrp, -9 - n % 5, n % 25,
                    b"%d" % (rsrp - 6) if n % 2 else b"",
                )
                for time, n, rsrp in rows
            )  # fmt: skip


# By reader.
SCALED: dict[str, tuple[Callable[[Path, int], None], str, ReadOptions]] = {
    "sounder_log": (write_sounder, "x_power_log.txt", ReadOptions(timezone=ZONE)),
    "vehicle_out": (write_vehicle, "x_vehicleOut.txt", ReadOptions(timezone=ZONE)),
    "quectel_csv": (write_quectel, "x_kpi.csv", ReadOptions(timezone=ZONE)),
    "drive_test": (write_drive_test, "x_phone.csv", ReadOptions(timezone=ZONE)),
}
TABLES: dict[str, tuple[int, int, list[int]]] = {
    # rows above, place of the time, places of further numbers
    "vehicle_out": (0, 11, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 13]),
    "quectel_csv": (0, 0, [2, 3, 4, 5, 7, 8, 9, 10]),
    "drive_test": (1, 0, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10]),
}


def contest(who: str, what: str, place: Path) -> dict[str, float]:
    """CPU and wall seconds, peak MiB above the imports, and MiB of the records of one contestant, in this process."""
    run = CONTESTANTS[who]
    small = place.parent / f"small_{place.name}"
    with place.open("rb") as file:
        small.write_bytes(b"".join(file.readlines(100_000)))
    run(what, small)  # imports and first-call costs do not count
    before = peak_mib()
    start, began = time.process_time(), time.perf_counter()
    columns = run(what, place)
    spent, passed = time.process_time() - start, time.perf_counter() - began
    peak = peak_mib()
    records = sum(column.nbytes for column in columns) / 2**20
    return {"cpu_s": spent, "wall_s": passed, "peak_mib": peak - before, "records_mib": records}


def _ours(what: str, place: Path) -> list[Any]:
    (file,) = ingest(place, options=SCALED[what][2], reader=what)
    return [frame[name].to_numpy() for frame in (s.frame for s in file.result.streams) for name in frame]


def _written(what: str, place: Path) -> list[Any]:
    """The same, and a flight file of it."""
    files = ingest(place, options=SCALED[what][2], reader=what)
    write_flight(place.with_suffix(".h5"), files)
    return [frame[name].to_numpy() for frame in (s.frame for s in files[0].result.streams) for name in frame]


def _utc(clock: pd.Series) -> np.ndarray:  # type: ignore[type-arg]
    return clock.dt.tz_localize(ZONE).dt.tz_convert("UTC").dt.tz_localize(None).to_numpy()


def _pandas(what: str, place: Path) -> list[Any]:
    if what == "sounder_log":
        frame = pd.read_csv(place, engine="c", header=None, sep=r"\s+")
        clock = pd.to_datetime(frame[0].str[1:] + " " + frame[1].str[:-1], format="%Y-%m-%d %H:%M:%S.%f")
        return [_utc(clock), frame[3].to_numpy()]
    skip, at, numbers = TABLES[what]
    frame = pd.read_csv(place, engine="c", header=None, skiprows=skip, quoting=3 if what == "vehicle_out" else 0)
    if what == "vehicle_out":
        for column in (4, 6, 7, 9):
            frame[column] = frame[column].str.strip('"()').astype(np.float64)
    values = [frame[column].to_numpy() for column in numbers]
    return [_utc(pd.to_datetime(frame[at], format="%Y-%m-%d %H:%M:%S.%f")), *values]


def _pandas_1(what: str, place: Path) -> list[Any]:
    """The same in one thread: pandas parses large files in several from 3.1 on."""
    if hasattr(pd.options.mode, "max_threads"):
        pd.set_option("mode.max_threads", 1)
    return _pandas(what, place)


CONTESTANTS = {"ours": _ours, "written": _written, "pandas_1": _pandas_1, "pandas": _pandas}


def scale(lines: int, formats: list[str], contestants: list[str], folder: str | None) -> None:
    """The table of peers."""
    import subprocess
    import sys
    import tempfile

    print(
        f"load {os.getloadavg()[0]:.1f}; peak above the imports; peers convert the times as well; "
        f"pandas {pd.__version__}, in one thread and as it comes (threads of its own from 3.1 on); "
        f"{os.cpu_count()} processors"
    )
    with tempfile.TemporaryDirectory(dir=folder) as folder_:
        for what in formats:
            write, name, _ = SCALED[what]
            place = Path(folder_) / name
            write(place, lines)
            print(f"{what}: {lines} lines, {place.stat().st_size / 1e6:.0f} MB")
            rows: dict[str, Any] = {}
            for who in contestants:
                command = [sys.executable, __file__, "--contest", who, what, str(place)]
                answer = subprocess.run(command, capture_output=True, text=True, check=False)
                if answer.returncode:
                    print(f"  {who:8} not run: {(answer.stderr.strip().splitlines() or ['?'])[-1][:90]}")
                    continue
                rows[who] = row = json.loads(answer.stdout)
                ours = rows.get("ours", {"cpu_s": np.nan, "wall_s": np.nan})
                ratio, by_wall = ours["cpu_s"] / row["cpu_s"], ours["wall_s"] / row["wall_s"]
                spent = f"{row['cpu_s']:8.2f} s CPU {row['wall_s']:8.2f} s wall"
                memory = f"peak {row['peak_mib']:7.0f} MiB, of which records {row['records_mib']:5.0f}"
                print(
                    f"  {who:8} {spent}   {memory}   ours takes {ratio:.2f} x its CPU, {by_wall:.2f} x its wall",
                    flush=True,
                )
            place.unlink()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=int, default=SCALE_LINES, metavar="LINES", help="lines of each file")
    parser.add_argument("--format", action="append", choices=sorted(SCALED), help="repeatable; all")
    parser.add_argument("--contestant", action="append", choices=list(CONTESTANTS), help="repeatable; all")
    parser.add_argument("--folder", help="where the files are made")
    parser.add_argument("--contest", nargs=3, metavar=("WHO", "WHAT", "FILE"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.contest:
        print(json.dumps(contest(given.contest[0], given.contest[1], Path(given.contest[2]))))
        return
    scale(given.scale, given.format or list(SCALED), given.contestant or list(CONTESTANTS), given.folder)


if __name__ == "__main__":
    main()
