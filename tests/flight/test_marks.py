"""Fingerprints recognise a changed copy of a log, and distinguish two flights of one route."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.flight import training
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.training import among, mark_of, series_mark
from tests.real_logs import REAL

Readings = tuple[np.ndarray, np.ndarray]
Change = Callable[[np.ndarray, np.ndarray], Readings]


def route_db(t: np.ndarray) -> np.ndarray:
    """Return the part of the level that every flight of one route shares: distance, and ripples of 40 s and 12 s."""
    return 8 * np.sin(t / 90) + 2 * np.sin(2 * np.pi * t / 40) + np.sin(2 * np.pi * t / 12)


def flown(seed: int, duration_s: float = 600.0, step_s: float = 0.25) -> Readings:
    """Seconds and levels [dB] past the same places, the fading of each flight its own (3 dB, 1 s)."""
    generator = np.random.default_rng(seed)
    t = np.arange(0.0, duration_s, step_s) + generator.uniform(-0.02, 0.02, round(duration_s / step_s))
    fading, kept = np.zeros(len(t)), np.exp(-step_s)
    for i, noise in enumerate(generator.normal(size=len(t))):
        fading[i] = kept * fading[i - 1] + 3.0 * np.sqrt(1 - kept**2) * noise
    return t, -70.0 + route_db(t) + fading


def averaged(t: np.ndarray, v: np.ndarray) -> Readings:
    second = np.floor(t + 0.3)
    values, place = np.unique(second, return_inverse=True)
    return values, np.bincount(place, v) / np.bincount(place)


CHANGES: dict[str, Change] = {
    "every other row": lambda t, v: (t[::2], v[::2]),
    "every fourth row": lambda t, v: (t[::4], v[::4]),
    "half of the rows by chance": lambda t, v: (t[1:][k := t[1:] * 7919 % 1 < 0.5], v[1:][k]),
    "shifted by 1 dB": lambda t, v: (t, v + 1.0),
    "another clock": lambda t, v: (t + 37.35, v),
    "resampled at 3 Hz": lambda t, v: (s := np.arange(t[0], t[-1], 1 / 3), np.interp(s, t, v)),
    "resampled at 0.7 Hz": lambda t, v: (s := np.arange(t[0], t[-1], 1 / 0.7), np.interp(s, t, v)),
    "means over seconds": averaged,
    "rounded to dB": lambda t, v: (t, np.round(v)),
    "as a loss in half decibels": lambda t, v: (t, -2.0 * v),
    "a quarter": lambda t, v: (t[len(t) // 2 : 3 * len(t) // 4], v[len(t) // 2 : 3 * len(t) // 4]),
    "a tenth, thinned and shifted": lambda t, v: (t[len(t) // 2 : 3 * len(t) // 5 : 2], v[len(t) // 2 : 3 * len(t) // 5 : 2] - 4),
    "in watts": lambda t, v: (t, 10 ** (v / 10 - 3)),
    "as powers over the first": lambda t, v: (t, 10 ** ((v - v[0]) / 10)),
    "seventeen minutes late": lambda t, v: (t + 1020.0, v),
    "backwards in the file": lambda t, v: (t[::-1], v[::-1]),
}  # fmt: skip


def mark(t: np.ndarray, v: np.ndarray, start: str = "2025-06-01T10:00:00") -> str:
    return mark_of(np.datetime64(start) + (t * 1e9).astype("timedelta64[ns]"), v)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_changed_copy_is_known_and_another_flight_of_the_route_is_not(change: str, seed: int) -> None:
    changed = mark(*CHANGES[change](*flown(seed)))
    assert among(changed, [mark(*flown(seed + 100)), mark(*flown(seed))])
    assert not among(changed, [mark(*flown(seed + number)) for number in range(100, 104)])


@pytest.mark.parametrize(
    "start", ["2025-06-01T14:00:00", "1970-01-01T00:00:00", "2025-06-01T10:20:00", "2024-06-01T10:00:00"]
)
def test_a_part_is_known_whatever_its_clock(start: str) -> None:
    t, v = flown(1)
    part = slice(len(t) // 3, None, 2)
    for one, other in ((mark(t, v), mark(t[part], v[part], start)), (mark(t[part], v[part]), mark(t, v, start))):
        assert among(other, [one])
        assert among(one, [other])


def tenths(v: np.ndarray) -> np.ndarray:
    return np.round(v, 1)


LATE: dict[str, Change] = {
    "tenths": lambda t, v: (t, tenths(v)),
    "a constant, in tenths": lambda t, v: (t, tenths(v + 3.37)),
    "a half, in tenths": lambda t, v: (t[: len(t) // 2], tenths(v[: len(t) // 2])),
    "every other row, a constant, in tenths": lambda t, v: (t[::2], tenths(v[::2] + 3.37)),
    "every third row": lambda t, v: (t[::3], v[::3]),
    "every fifth row": lambda t, v: (t[::5], v[::5]),
}


@pytest.mark.parametrize("change", LATE)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_changed_copy_with_another_clock_is_known(change: str, seed: int) -> None:
    """A later day, not at a whole hour. The clock says that it is a repeat flight, its readings that it is a copy."""
    t, v = flown(seed, duration_s=900.0)
    late = mark(*LATE[change](t, v), start="2025-06-03T11:17:23")
    assert among(late, [mark(t, v)])
    assert not among(late, [mark(*flown(other, duration_s=900.0)) for other in range(100, 104)])


@pytest.mark.parametrize("noise_db", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("ripple_db", [2.0, 6.0])
def test_a_repeat_flight_with_little_noise_is_another_flight(noise_db: float, ripple_db: float) -> None:
    """Levels at equal places differ by little: the route is flown exactly again."""
    t = np.arange(0.0, 900.0, 0.25)
    route = route_db(t) + ripple_db * np.sin(2 * np.pi * t / 9.7) * np.sin(2 * np.pi * (t / 130) ** 2)
    levels = [np.round(route + np.random.default_rng(i).normal(0, noise_db, len(t)), 2) for i in range(4)]
    marks = [mark(t, level, f"2025-06-0{day}T1{day}:17:23") for day, level in enumerate(levels, 1)]
    assert all(len(training._parts(each)[2]) == training._RUNS for each in marks)
    assert [(i, j) for i in range(4) for j in range(i) if among(marks[i], [marks[j]])] == []


def test_a_repeat_flight_of_the_same_ripple_is_another_flight() -> None:
    """An automated route repeats the ripple of the ground reflection: r is 0.9 here, on another day and hour."""
    t = np.arange(0.0, 600.0, 0.5)
    ripple = 6 * np.sin(2 * np.pi * t / 9.7) * np.sin(2 * np.pi * (t / 130) ** 2)
    levels = [np.round(-70 + ripple + np.random.default_rng(i).normal(0, 2, len(t)), 1) for i in range(2)]
    start = "2025-06-01T10:00:00"
    for other in ("2025-06-02T10:00:00", "2025-06-01T10:20:00", "2025-06-01T13:31:00"):
        assert not among(mark(t, levels[1], other), [mark(t, levels[0], start)])
        assert among(mark(t[99:], levels[0][99:], other), [mark(t, levels[0], start)])
    # at one time, or at another time zone, nothing but the correlation is necessary
    for same in (start, "2025-06-01T14:00:00"):
        assert among(mark(t, levels[1], same), [mark(t, levels[0], start)])


def test_runs_of_a_quantised_level_are_shared_by_copies_only() -> None:
    """Whole dB repeat by chance: none of 15 pairs of flights may share a run."""
    t = np.arange(0.0, 1200.0, 0.25)
    levels = [np.round(-90 + np.random.default_rng(i).normal(0, 0.8, len(t))) for i in range(6)]
    runs = [training._parts(mark(t, level))[2] for level in levels]
    assert all(len(one) == training._RUNS for one in runs)
    assert max(len(runs[i] & runs[j]) for i in range(6) for j in range(i)) == 0


def test_ranks_of_a_repeat_flight_are_another_log() -> None:
    """Ranks follow the place: without noise two flights of one route report the same ones, on any day."""
    t = np.arange(0.0, 600.0, 0.5)
    place = np.sin(2 * np.pi * t / 37.0) + np.sin(2 * np.pi * (t / 130) ** 2)
    ranks = np.clip(np.round(2.5 + place + np.random.default_rng(4).normal(0, 0.7, len(t))), 1, 4)
    first, again = (mark(t, ranks, start) for start in ("2025-06-01T10:00:00", "2025-06-02T10:20:00"))
    assert first
    assert not among(again, [first])
    assert among(mark(t[99:], ranks[99:], "2025-06-01T10:00:00"), [first])


def test_what_tells_too_little_has_no_mark() -> None:
    """Constants, levels of the route alone, what repeats itself, too short a log, no times, nothing."""
    t, v = flown(1)
    for readings in (
        np.full(len(t), -90.0), route_db(t), np.tile(v[: len(v) // 4], 4), np.where(t < 30, v, np.nan), np.full(len(t), np.nan),
    ):  # fmt: skip
        assert mark(t, readings) == ""
    assert mark_of(np.full(len(t), np.datetime64("NaT", "ns")), v) == ""
    assert not among("", [mark(t, v)])


@pytest.mark.parametrize("foreign", ["", "7", "x" * 400, "\u00e9" * 400, "7" * 400, "." * 400, "07e" * 9000])
def test_strange_marks_of_a_file_are_of_no_log(foreign: str) -> None:
    assert not among(mark(*flown(1)), [foreign])


@pytest.mark.parametrize("often", [0.05, 0.1, 0.3])
def test_a_quarter_of_a_rank_log_is_known(often: float) -> None:
    """Rows without CSI and another base of the rank indicator do not matter.

    Another flight of the same modem is a different log.
    """

    def held(seed: int) -> Readings:
        generator = np.random.default_rng(seed)
        steps = np.where(generator.random(2000) < often, generator.integers(1, 4, 2000), 0)
        return np.arange(2000) * 0.5, 1.0 + np.cumsum(steps) % 4

    t, rank = held(1)
    gaps = np.where(np.arange(2000) % 7, rank - 1.0, np.nan)
    for start in (0, 500, 1000, 1500):
        quarter = mark(t[start : start + 500], gaps[start : start + 500])
        assert among(quarter, [mark(t, rank)])
        assert not among(quarter, [mark(*held(seed)) for seed in range(2, 6)])


# --- real flights -----------------------------------------------------------------------------------------------------

HERE = Path(__file__).parents[1] / "field"
FLIGHTS = [
    *(f"learned/ds12_{name}.yaml" for name in ("40m_fs10MHz", "40m_fs5MHz", "70m_fs20MHz")),
    *(f"calibrations/{name}.yaml" for name in ("afar300_loc_1", "afar300_loc_2", "afar309_loc_2", "afar328_loc_1")),
    *(f"calibrations/{name}.yaml" for name in ("afar328_loc_3", "lte50", "lte90")),
    *("nr_rank_flight1.yaml", "nr_rank_flight3.yaml", "aadm.yaml"),
]


@pytest.fixture(scope="module")
def flights() -> list[FlightData]:
    return [load_data(load_flight(HERE / name), (HERE / name).parent, REAL) for name in FLIGHTS]


@pytest.mark.field
def test_real_flights_are_known_by_changed_copies_with_another_clock(flights: list[FlightData]) -> None:
    missed = []
    for name, data in zip(FLIGHTS, flights, strict=True):
        for series in data.rss:
            good = np.isfinite(v := series.measured_db)
            t, own = (series.time[good] - series.time.min()) / np.timedelta64(1, "s"), series_mark(series)
            start = str(series.time.min() + np.timedelta64(2 * 86400 + 4643, "s"))
            missed += [(name, change) for change, do in LATE.items() if not among(mark(*do(t, v[good]), start), [own])]
    assert {change for _, change in missed} <= {"every fifth row"}
    assert len(missed) <= 2


@pytest.mark.field
def test_real_flights_are_known_by_changed_copies_and_never_for_each_other(flights: list[FlightData]) -> None:
    """Three of dataset 12 and five of AFAR flew one route each."""
    known = [[m for _, s in data.series if (m := series_mark(s))] for data in flights]
    assert all(known)
    digits = [[m.split("f")[1] for m in group] for group in known]  # not even without the clocks
    pairs = [(i, j) for i in range(len(known)) for j in range(i)]
    assert [(FLIGHTS[i], FLIGHTS[j]) for i, j in pairs if any(among(m, digits[j]) for m in digits[i])] == []
    missed = []
    for name, data in zip(FLIGHTS, flights, strict=True):
        _, series = data.series[0]
        good = np.isfinite(v := getattr(series, "measured_db", getattr(series, "rank", None)))
        t = (series.time[good] - series.time.min()) / np.timedelta64(1, "s")
        own = series_mark(series)
        missed += [
            (name, change)
            for change, do in CHANGES.items()
            if not among(mark(*do(t, v[good]), str(series.time.min())), [own])
        ]
    assert [
        item for item in missed if item[1] != "a tenth, thinned and shifted"
    ] == []  # a tenth is 34 s of the shortest
    assert len(missed) <= 3
