"""Inject faults: is the cause of a flight's error named rightly, and is a healthy flight not accused?

    python benchmarks/injected_causes.py FIELD [--seed 1] [--only TEXT] [--keep FOLDER] [--healthy] [--time]

Each real flight at LW1 is predicted from the other flights of its campaign (learned again without it) and drafted from
its healthy log. A fault is written into the columns of the log, which is read, replayed and compared as in a report.
Simulated flights have isotropic antennas, a ground reflection and correlated fading, and no learned antennas. Sizes,
times, channels and directions are drawn by the seed. ``OUTSIDE`` and :mod:`outside_causes` have kinds that the
candidates do not contain. For these no name is right, except where a name describes the kind.

The script prints a row per kind: right, silent, silent at a cost below 0.3 dB, and wrong with the names that were
given. With ``--healthy`` it prints the causes of complete flights, thirds and sixths without a fault. With ``--time``
it prints the share of the search for a cause in the processor time of a report: the first report of the process, which
loads all libraries, two more, and three of the same flight with antennas that were learned from the other flights. The
exit code is 1 if more than 3 % of the real or of the simulated cases have a wrong name, or if less than 80 % of the
listed kinds that cost more than 0.3 dB are named rightly.
"""

# ruff: noqa: ARG005  a fault takes a level, its table and a generator, and some need one of them

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import tempfile
import unittest.mock
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import yaml
from left_out_reports import TIMEZONE, recipe_of_campaign, site_without
from outside_causes import KINDS, LEVELS, Array, Table, levels, seconds
from planted_causes import TOWER, fading, flown, unmodelled
from scipy.io import loadmat, savemat

from aerpaw_cmp.__main__ import main as command
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import wrap_degrees
from aerpaw_cmp.compare.result import FlightResult
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.replay import FlightReplay, replay_flight
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs import compare_flight as compare
from aerpaw_cmp.jobs.flight_run import flight_comparison
from aerpaw_cmp.jobs.likely_cause import cause_of
from aerpaw_cmp.site.siteyaml import load_site

Fault = Callable[[Table, np.random.Generator], None]
NONE = "none"
# A fault that costs less [dB] changes no decision.
LEAST_DB = 0.3


def channels(t: Table, draw: np.random.Generator) -> list[str]:
    """All level columns, or one of them."""
    names = levels(t)
    return names if draw.random() < 0.5 else [str(draw.choice(names))]


def shifted_by(seconds_of: Callable[[Array, np.random.Generator], Array]) -> Fault:
    """Levels that are logged later by a function of time."""

    def fault(t: Table, draw: np.random.Generator) -> None:
        time = seconds(t)
        late = seconds_of(time, draw)
        for name in LEVELS:
            if name in t:
                t[name] = np.interp(time - late, time, t[name])

    return fault


def levels_by(change: Callable[[Array, Table, np.random.Generator], Array], *, every: bool = False) -> Fault:
    """Change the levels of one channel, or of all channels. All channels of one fault use the same random numbers."""

    def fault(t: Table, draw: np.random.Generator) -> None:
        names = levels(t) if every else channels(t, draw)
        seed = int(draw.integers(1 << 30))
        for name in names:
            t[name] = change(t[name].astype(np.float64), t, np.random.default_rng(seed))

    return fault


def swapped(*pairs: tuple[str, str]) -> Fault:
    """Exchange pairs of columns, if both exist."""

    def fault(t: Table, _: np.random.Generator) -> None:
        for a, b in pairs:
            if a in t and b in t:
                t[a], t[b] = t[b], t[a]

    return fault


def column(name: str, change: Callable[[Array, np.random.Generator], Array]) -> Fault:
    """One column of the telemetry after a change."""

    def fault(t: Table, draw: np.random.Generator) -> None:
        if name in t:
            t[name] = change(t[name].astype(np.float64), draw)

    return fault


def displaced(t: Table, draw: np.random.Generator) -> None:
    """A track 60 to 250 m from its place."""
    radius, angle = draw.choice([60.0, 120.0, 250.0]), draw.uniform(0.0, 2.0 * np.pi)
    t["mX"] = t["mX"] + radius * np.sin(angle) / 90_400.0
    t["mY"] = t["mY"] + radius * np.cos(angle) / 111_000.0


def mirrored(t: Table, _: np.random.Generator) -> None:
    """East and north of the track exchanged about its first position."""
    east, north = (t["mX"] - t["mX"][0]) * 90_400.0, (t["mY"] - t["mY"][0]) * 111_000.0
    t["mX"], t["mY"] = t["mX"][0] + north / 90_400.0, t["mY"][0] + east / 111_000.0


def still(t: Table, draw: np.random.Generator, names: tuple[str, ...], length_s: float) -> None:
    """Columns that keep one value for some time."""
    time = seconds(t)
    begin = draw.uniform(0.2, 0.7) * time[-1]
    inside = (time >= begin) & (time < begin + length_s)
    for name in names:
        if name in t:
            t[name] = np.where(inside, t[name][int(np.argmax(inside))], t[name])


def towards(t: Table) -> tuple[Array, Array]:
    """Azimuth of the UAV from the tower [rad], and their distance [m]."""
    tower = load_site("lake_wheeler").towers[TOWER]
    east = (t["mX"] - tower.longitude_deg) * 90_400.0
    north = (t["mY"] - tower.latitude_deg) * 111_000.0
    return np.arctan2(east, north), np.sqrt(east**2 + north**2 + (t["mZ"] - tower.antenna_height_m) ** 2)


def stepped(level: Array, t: Table, draw: np.random.Generator) -> Array:
    time = seconds(t)
    return level + draw.choice([-1, 1]) * draw.choice([4.0, 7.0, 12.0]) * (time > draw.uniform(0.3, 0.7) * time[-1])


def shadowed(level: Array, t: Table, draw: np.random.Generator) -> Array:
    azimuth, _ = towards(t)
    off = np.abs(np.angle(np.exp(1j * (azimuth - draw.choice(azimuth)))))
    return level - draw.choice([8.0, 12.0, 18.0]) * (off < np.radians(draw.uniform(10.0, 25.0)))


def lobed(level: Array, t: Table, draw: np.random.Generator) -> Array:
    azimuth, _ = towards(t)
    body = azimuth + np.pi - np.radians(t.get("mYaw", 0.0 * azimuth))
    return level + draw.choice([4.0, 6.0, 8.0]) * np.sin(draw.choice([1, 2]) * body + draw.uniform(0.0, 6.0))


def slow_gain(level: Array, t: Table, draw: np.random.Generator) -> Array:
    """A gain control of 20 s that takes off a share of what it sees."""
    time = seconds(t)
    keep = np.exp(-np.diff(time, prepend=time[0]) / draw.choice([10.0, 20.0, 40.0]))
    mean = level.copy()
    for i in range(1, len(level)):
        mean[i] = keep[i] * mean[i - 1] + (1.0 - keep[i]) * level[i]
    return np.asarray(level - draw.choice([0.6, 0.8, 0.95]) * (mean - mean.mean()))


def averaged(level: Array, t: Table, _: np.random.Generator) -> Array:
    time = seconds(t)
    place = np.floor(time / 20.0).astype(np.int64)
    return np.asarray((np.bincount(place, level) / np.maximum(np.bincount(place), 1))[place])


def bursts(level: Array, t: Table, draw: np.random.Generator) -> Array:
    time = seconds(t)
    hit = np.zeros(len(time), dtype=np.bool_)
    for begin in draw.uniform(0.0, time[-1], 12):
        hit |= (time > begin) & (time < begin + draw.uniform(3.0, 12.0))
    return level + draw.choice([8.0, 15.0]) * hit


def wave(level: Array, t: Table, draw: np.random.Generator) -> Array:
    return level + draw.choice([4.0, 7.0]) * np.sin(
        2 * np.pi * seconds(t) / draw.choice([45.0, 90.0]) + draw.uniform(0, 6)
    )


def ramp(level: Array, t: Table, draw: np.random.Generator) -> Array:
    return level + draw.choice([-1, 1]) * draw.choice([6.0, 10.0]) * seconds(t) / seconds(t)[-1]


def faded(level: Array, t: Table, draw: np.random.Generator) -> Array:
    """Rain or a person before the antenna: a loss of two minutes with soft edges."""
    time, middle = seconds(t), draw.uniform(0.3, 0.7) * seconds(t)[-1]
    return level - draw.choice([6.0, 12.0]) * np.exp(-0.5 * ((time - middle) / 40.0) ** 2)


def soft(level: Array, limit: float, side: float) -> Array:
    return np.asarray(limit + side * 10.0 * np.log10(1.0 + 10.0 ** (side * (level - limit) / 10.0)))


def quantile(level: Array, draw: np.random.Generator, side: float) -> float:
    share = float(draw.choice([0.3, 0.45, 0.6]))
    return float(np.quantile(level, share if side > 0 else 1.0 - share))


def exponent(level: Array, t: Table, draw: np.random.Generator) -> Array:
    return level - draw.choice([10.0, 15.0, 20.0]) * np.log10(towards(t)[1])


def jittered(time: Array, draw: np.random.Generator) -> Array:
    """Lags that change every 15 s."""
    knots = np.arange(0.0, time[-1] + 30.0, 15.0)
    return np.interp(time, knots, draw.normal(0.0, 4.0, len(knots)))


def other_track(t: Table, _: np.random.Generator) -> None:
    """The telemetry of another flight: this one's, backwards."""
    for name in ("mX", "mY", "mZ", "mYaw", "mRoll", "mPitch"):
        if name in t:
            t[name] = t[name][::-1].copy()


# Kinds with the names that are right.
LISTED: Mapping[str, tuple[Fault, tuple[str, ...]]] = {
    "clock lag": (shifted_by(lambda x, d: d.choice([-8.0, -4.0, 4.0, 8.0]) + 0.0 * x), ("clock",)),
    "clock drift": (shifted_by(lambda x, d: d.choice([-0.02, 0.015, 0.03]) * x), ("clock",)),
    "gain step": (levels_by(stepped), ("gain step",)),
    "gain step, all channels": (levels_by(stepped, every=True), ("gain step",)),
    "loose cable": (levels_by(lambda x, t, d: x - 12.0 * (seconds(t) > 0.5 * seconds(t)[-1])), ("gain step",)),
    "hard floor": (levels_by(lambda x, t, d: np.maximum(x, quantile(x, d, 1.0))), ("floor", "no detection")),
    "soft floor": (levels_by(lambda x, t, d: soft(x, quantile(x, d, 1.0), 1.0)), ("floor", "no detection")),
    "hard ceiling": (levels_by(lambda x, t, d: np.minimum(x, quantile(x, d, -1.0))), ("saturation",)),
    "soft ceiling": (levels_by(lambda x, t, d: soft(x, quantile(x, d, -1.0), -1.0)), ("saturation",)),
    "flat": (levels_by(lambda x, t, d: np.nanmedian(x) + d.normal(0.0, 0.3, len(x))),
             ("flat", "floor", "no detection")),
    "halved decibels": (levels_by(lambda x, t, d: x + 0.5 * (np.nanmedian(x) - x), every=True), ("decibels",)),
    "doubled decibels": (levels_by(lambda x, t, d: x + x - np.nanmedian(x), every=True), ("decibels",)),
    "heights in feet": (column("mZ", lambda x, d: 3.2808 * x), ("telemetry",)),
    "heights by 3.28": (column("mZ", lambda x, d: x / 3.2808), ("telemetry",)),
    "heights too high": (column("mZ", lambda x, d: x + d.choice([50.0, 80.0, 113.0]) * (x > 3.0)), ("height",)),
    "yaw turned": (column("mYaw", lambda x, d: x + d.choice([60.0, 90.0, 180.0])), ("heading",)),
    "yaw sign": (column("mYaw", lambda x, d: -x), ("telemetry", "heading")),
    "yaw from east": (column("mYaw", lambda x, d: 90.0 - x), ("telemetry", "heading")),
    "roll and pitch swapped": (swapped(("mRoll", "mPitch")), ("telemetry",)),
    "roll and yaw swapped": (swapped(("mRoll", "mYaw")), ("telemetry", "heading")),
    "channels swapped": (swapped(("mpower1", "mpower2")), ("channels",)),
    "track displaced": (displaced, ("place",)),
    "track mirrored": (mirrored, ("telemetry",)),
    "another antenna": (levels_by(lobed, every=True), ("pattern", "heading")),
    "shadow": (levels_by(shadowed, every=True), ("blocked",)),
    "gain step, then a lag": (lambda t, d: (levels_by(stepped)(t, d), shifted_by(lambda x, _: 5.0 + 0.0 * x)(t, d))[0],
                              ("gain step", "clock")),
}  # fmt: skip
OUTSIDE: Mapping[str, Fault] = {
    "slow gain control": levels_by(slow_gain),
    "means of 20 s": levels_by(averaged, every=True),
    "telemetry backwards": other_track,
    "gain that creeps": levels_by(ramp, every=True),
    "gain that swings": levels_by(wave, every=True),
    "interference bursts": levels_by(bursts, every=True),
    "a loss of two minutes": levels_by(faded, every=True),
    "white noise of 6 dB": levels_by(lambda x, t, d: x + d.normal(0.0, 6.0, len(x))),
    "levels by 5 dB": levels_by(lambda x, t, d: 5.0 * np.round(x / 5.0), every=True),
    "path-loss exponent": levels_by(exponent, every=True),
    "times that jitter": shifted_by(jittered),
    "positions frozen": lambda t, d: still(t, d, ("mX", "mY"), 120.0),
    "levels frozen": lambda t, d: still(t, d, LEVELS, 70.0),
    "height creeps": column("mZ", lambda x, d: x + np.linspace(0.0, d.choice([30.0, 60.0]), len(x))),
    "levels backwards": levels_by(lambda x, t, d: x[::-1].copy(), every=True),
    "levels of another minute": levels_by(lambda x, t, d: np.roll(x, len(x) // 3), every=True),
}  # fmt: skip
# A fault of a height or a clock that grows is what a height or a clock explains, and an exponent has its name.
ALSO = {"height creeps": ("height",), "levels of another minute": ("clock",), "path-loss exponent": ("exponent",)}


@dataclass(frozen=True)
class Flight:
    """A flight with its settings in a folder, the columns of its healthy log, and whether it is a real one."""

    name: str
    folder: Path
    table: Table
    real: bool

    def replayed(self, table: Table) -> tuple[FlightData, FlightReplay]:
        """Return the flight with another table as its log, and its replay."""
        settings = load_with_learned(self.folder / "flight.yaml")
        savemat(self.folder / settings.logs[0].path, table)
        data = load_data(settings, self.folder)
        return data, replay_flight(data)

    def result(self, table: Table) -> FlightResult:
        """Comparison of the flight with another table as its log."""
        return compare.compare_flight(*self.replayed(table))


def error_db(result: FlightResult) -> float:
    """RMSE over all series [dB]."""
    known = [panel.score.rmse_db for panel in result.rss if np.isfinite(panel.score.rmse_db)]
    return float(np.sqrt(np.mean(np.square(known)))) if known else float("nan")


def drafted(log: Path, table: Table, site: Path) -> None:
    """Write the log, and its draft into the same folder."""
    savemat(log, table)
    words = ["ingest", log, "--timezone", TIMEZONE, "--site", site, "--draft", log.with_name("flight.yaml"), "--force"]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert command([*map(str, words)]) == 0


def real_flights(field: Path, keep: Path, only: str) -> Iterator[Flight]:
    """The flights at LW1 whose name contains a text, each with a site that was learned without it."""
    for name in ("dataset12", "lte"):
        recipe = recipe_of_campaign(name)
        for flight in yaml.safe_load(recipe.read_text(encoding="utf-8"))["campaigns"][name]["flights"]:
            if only not in Path(flight).stem:
                continue
            folder = keep / name / Path(flight).stem
            if not (folder / "site.yaml").is_file():
                folder.mkdir(parents=True, exist_ok=True)
                site_without(recipe, flight, field, folder)
            log = field / load_flight(recipe.parent / flight).logs[0].path
            table = {k: v.ravel() for k, v in loadmat(log).items() if not k.startswith("__")}
            drafted(folder / log.name, table, folder / "site.yaml")
            yield Flight(Path(flight).stem, folder, table, real=True)


def simulated_flights(count: int, keep: Path, seed: int) -> Iterator[Flight]:
    """Flights in the columns of dataset 12, with isotropic antennas."""
    tower = load_site("lake_wheeler").towers[TOWER]
    for number in range(count):
        draw = np.random.default_rng([seed, number])
        while (plan := flown(draw)).time_s[-1] < 240.0:
            pass
        place = plan.place_m + np.array([*tower.position_m[:2], 0.0])
        ray = place - tower.position_m
        clean = -20.0 * np.log10(np.linalg.norm(ray, axis=1)) - 40.0
        time = 1_721_046_400.0 + plan.time_s
        frame = load_site("lake_wheeler").frame
        latitude, longitude = frame.to_geographic(place[:, 0], place[:, 1])
        yaw, pitch, roll = wrap_degrees(np.degrees(plan.turns)).T
        table = {"timestamp_power": time, "mX": longitude, "mY": latitude, "mZ": place[:, 2],
                 "mYaw": yaw, "mPitch": pitch, "mRoll": roll}  # fmt: skip
        for name in LEVELS[:2]:
            table[name] = clean + unmodelled(draw, tower.position_m, place) + fading(draw, plan.time_s)
        folder = keep / f"simulated_{seed}_{number}"
        folder.mkdir(parents=True, exist_ok=True)
        settings = {
            "flight": folder.name, "site": "lake_wheeler", "timezone": TIMEZONE,
            "logs": [{"path": "flight.mat", "reader": "flight_mat", "node": TOWER}],
            "link": {"rss": {"carrier_hz": 3.3e9, "transmit_power_dbm": 40, "uav_transmits": True}},
            "rt": {"max_depth": 0}, "rss": {"minimum_height_m": 5, "field": "power"},
        }  # fmt: skip
        (folder / "flight.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
        yield Flight(folder.name, folder, table, real=False)


def named(result: FlightResult) -> str:
    """Name of the likely cause."""
    return NONE if result.likely_cause is None else result.likely_cause.name


def healthy(flights: list[Flight]) -> None:
    """Print the causes of whole flights, thirds and sixths without a fault, and what their recommendations cost."""
    accused = parts = 0
    costs_db = list[float]()
    for flight in flights:
        complete = None
        for of in (1, 3, 6):
            for k in range(of):
                cut = {n: v[k * v.size // of : (k + 1) * v.size // of] for n, v in flight.table.items()}
                replayed = flight.replayed(cut)
                cause = compare.compare_flight(*replayed).likely_cause
                parts, accused = parts + (of > 1), accused + (of > 1 and cause is not None)
                if cause is not None:
                    print(f"{flight.name}, part {k + 1} of {of}: {cause.sentence}")
                comparison = flight_comparison(*replayed)
                complete = complete or comparison
                if complete and comparison and (model := comparison.recommended):
                    # the last model is that of the flight file
                    rmse_db = dict(zip(complete.models, complete.scores.rmse_db, strict=True))
                    costs_db.append(rmse_db[model] - rmse_db[None] if model in rmse_db else np.inf)
                    print(f"{flight.name}, part {k + 1} of {of}: {model.name}, {costs_db[-1]:+.2f} dB on the flight")
    print(f"accused: {accused} of {parts} healthy thirds and sixths")
    most_db = max(costs_db, default=0.0)
    print(f"other models recommended: {len(costs_db)}, with at most {most_db:+.2f} dB on the complete flight")


def time_of_cause(field: Path, keep: Path) -> None:
    """Print the share of the cause in the processor time of reports of dataset 12, without and with antennas."""
    spent_s = [0.0]

    def timed(*given: Any) -> Any:
        start = process_time()
        found = cause_of(*given)
        spent_s[0] = process_time() - start
        return found

    flight, root = Path(__file__).parents[1] / "tests/field/dataset12_40m.yaml", field
    with tempfile.TemporaryDirectory() as out, unittest.mock.patch.object(compare, cause_of.__name__, timed):
        for number in range(6):
            if number == 3:
                root = next(real_flights(field, keep, "40m_fs10MHz")).folder
                flight = root / "flight.yaml"
            start = 0.0 if number == 0 else process_time()
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                assert command(["report", str(flight), "--logs-root", str(root), "-o", out, "--force"]) == 0
            report_s = process_time() - start
            antennas = "learned antennas" if number >= 3 else "isotropic antennas"
            share = f"{spent_s[0]:.2f} s ({spent_s[0] / report_s:.0%})"
            print(f"report {number + 1}, {antennas}: {report_s:.1f} s, cause {share}", flush=True)


def main() -> int:
    """Print the table and the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = os.environ.get("AERPAW_CMP_FIELD_DATA")
    parser.add_argument("field", type=Path, nargs="?" if known else None, default=known, help="folder of real logs")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="flights or kinds whose name contains this")
    parser.add_argument("--keep", type=Path, help="folder for the learned sites, used again by the next run")
    parser.add_argument("--simulated", type=int, default=3, help="simulated flights")
    parser.add_argument("--healthy", action="store_true", help="whole flights, thirds and sixths without a fault")
    parser.add_argument("--time", action="store_true", help="processor time of the cause in a report of dataset 12")
    given = parser.parse_args()
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    counts: Counter[tuple[bool, str]] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        keep = given.keep or Path(scratch)
        if given.time:
            time_of_cause(given.field, keep)
            return 0
        kinds = {kind: right for kind, (_, right) in LISTED.items()}
        kinds |= {kind: ALSO.get(kind, ()) for kind in OUTSIDE}
        kinds |= {kind: outside.allowed for kind, outside in KINDS.items()}
        of_kinds = any(given.only in kind for kind in kinds)
        flights = [*real_flights(given.field, keep, "" if of_kinds else given.only)]
        if given.healthy:
            healthy(flights)
            return 0
        flights += simulated_flights(given.simulated, keep, given.seed)
        for flight in flights:
            sound_db = error_db(flight.result(flight.table))
            for number, (kind, right) in enumerate(kinds.items()):
                if given.only not in flight.name and given.only not in kind:
                    continue
                table = {name: values.copy() for name, values in flight.table.items()}
                if kind in KINDS:
                    size = KINDS[kind].inject(table, kind, flight.name, given.seed)
                else:
                    size = "a drawn size"
                    fault = LISTED[kind][0] if kind in LISTED else OUTSIDE[kind]
                    fault(table, np.random.default_rng([given.seed, number, *flight.name.encode()]))
                if all(np.array_equal(table[name], flight.table[name]) for name in table):
                    continue  # the log has no such column
                try:
                    result = flight.result(table)
                except InputError:  # refused with a reason
                    rows[kind]["refused"] += 1
                    continue
                name, cost_db = named(result), error_db(result) - sound_db
                outcome = (
                    "right" if set(name.split(" or ")) & set(right) or (name == NONE and kind not in LISTED)
                    else "silent" if name == NONE and not cost_db < LEAST_DB
                    else "silent, no cost" if name == NONE
                    else "wrong"
                )  # fmt: skip
                rows[kind][outcome if outcome != "wrong" else f"wrong: {name}"] += 1
                counts[flight.real, outcome] += 1
                if kind in LISTED and cost_db >= LEAST_DB:
                    counts[flight.real, f"costly {outcome}"] += 1
                if outcome in ("wrong", "silent"):
                    cause = "silent" if result.likely_cause is None else result.likely_cause.sentence
                    print(f"    {flight.name}, {kind} by {size} ({cost_db:+.1f} dB): {cause}", flush=True)
    for kind in kinds:
        outside = "" if kind in LISTED else " (outside)"
        print(f"{kind + outside:36} " + ", ".join(f"{name} {n}" for name, n in sorted(rows[kind].items())))
    failed = False
    for real in (True, False):
        total = sum(counts[real, name] for name in ("right", "silent", "silent, no cost", "wrong"))
        costly = sum(counts[real, f"costly {name}"] for name in ("right", "silent", "wrong"))
        right, wrong = counts[real, "costly right"], counts[real, "wrong"]
        where = "real" if real else "simulated"
        print(f"{where}: {total} cases, wrong names {wrong} ({wrong / max(total, 1):.1%}); listed kinds that cost "
              f"{LEAST_DB} dB: right {right} of {costly} ({right / max(costly, 1):.1%})")  # fmt: skip
        failed |= wrong > 0.03 * total or right < 0.8 * costly
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
