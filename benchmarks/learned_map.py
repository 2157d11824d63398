"""Measure errors and intervals of learned antennas and their residual field on held-out parts of real flights.

``flights``: each flight of dataset 12 is predicted from the other two.

``blocks``: blocks of 300 m (and 20 m around them) of each flight are held out. Known are the rest of the flight and one
other flight, or the same with antennas learned also on the third flight, or both other flights.

``lte``: 25 samples of a flight are predicted from M others by the protocol of the data's authors (single samples
without take-off and landing, scales from another height, 300 draws), with the other height known. Printed are the root
mean square over all draws, and in brackets the median over draws, which the authors print. The last row knows all of
the flight except 20 s around the target.

``crps``: predictions with and without the residual field, with each flight held out, or eighths of a single flight. The
field is chosen on the known flights.

``ranks``: the log score of a receiver that was learned on another flight, alone and with a residual field on its logits
(a kernel logistic, whose shift is the same at all places). The field is learned on the rest of the flight except 300 m
and 20 s around the target, on earlier reports, or on the training flight of the receiver.

    AERPAW_CMP_FIELD_DATA=... python benchmarks/learned_map.py [--only flights blocks lte crps ranks] [--quick]
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import log_softmax, softmax

from aerpaw_cmp.common.units import BoolArray, FloatArray
from aerpaw_cmp.compare.calibration import BIN_S, OFF, Correction, Observed, choose, score
from aerpaw_cmp.compare.field_gp import FieldFit, FieldModel, Rows, fit_field
from aerpaw_cmp.compare.gains import LinkSamples, fading_of
from aerpaw_cmp.compare.level import crps_normal
from aerpaw_cmp.compare.statistics import mean_interval
from aerpaw_cmp.flight.settings import AntennaSettings
from aerpaw_cmp.jobs.calibrate import gain_of, learned_antennas, observe
from aerpaw_cmp.jobs.calibrate_rank import FittedReceiver, RankSamples, Tried, rank_samples
from aerpaw_cmp.propagation.field.baselines import two_ray_dbm

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.published import tasks

DATASET12 = ("40m_fs10MHz", "40m_fs5MHz", "70m_fs20MHz")
LTE = ("lte_plotdata2", "lte_plotdata4")
AFAR = ("afar_300_loc_1", "afar_300_loc_2", "afar_309_loc_2", "afar_328_loc_1", "afar_328_loc_3", "afar_288_loc_1")
# Its levels are not a task of the benchmark: one flight of the folder has them with positions.
NR = {
    "timezone": "America/New_York",
    "site": {"file": "lake_wheeler", "coordinates": "A", "without_buildings": True},
    "logs": [{"path": "nr_rsrp", "node": "LW1"}],
    "link": {"rss": {"carrier_hz": 3.4e9}},
}
BLOCK_LINE = ("learned {:.3f} dB, {:.3f} about the mean error of each series (90 % holds {:.0f} %); with the chosen "
              "field {:.3f}, {:.3f} ({:.0f} %), on in {:.0f} % of blocks")  # fmt: skip
MEANS_S, TARGETS, GUARD_S = 3.0, 25, 20.0
# Lengths over place [m] and strengths of the residual field on a receiver's logits; an infinite length is a shift.
RANK_FIELDS = {
    "a shift": [(np.inf, 1.0)], "0.6 over 15 m": [(15.0, 0.6)], "0.6 over 40 m": [(40.0, 0.6)],
    "0.6 over 100 m": [(100.0, 0.6)], "1.0 over 100 m": [(100.0, 1.0)],
    "0.6 over 100 m and a shift": [(100.0, 0.6), (np.inf, 1.0)],
}  # fmt: skip
# Reports that are predicted from those before, in such parts and from this time on.
AHEAD_S, FIRST_S = 30.0, 120.0
# Times as far as places.
HEIGHT_COUNTS = 2.0
# Errors and stated standard deviations (n,) [dB].
Part = tuple[FloatArray, FloatArray]


class Bench(tasks.Bench):
    """Published flights as samples to learn from."""

    def observed(self, flight: str) -> list[Observed]:
        """Level samples of a flight, known ones alone."""
        parts, _ = observe([self.flight(flight).data])
        return [o.part(np.isfinite(o.samples.residual_db)) for o in parts]

    def ranks(self, flight: str) -> list[RankSamples]:
        """Rank reports of a flight, those with CSI alone."""
        data = self.flight(flight).data
        return [samples.part(samples.rank >= 1) for samples in (rank_samples(data, series) for series in data.rank)]


def rows_of(o: Observed) -> pd.DataFrame:
    """Columns by which splits are made."""
    assert o.start is not None
    time = o.start + (o.samples.time_s * 1e9).round().astype("timedelta64[ns]")
    rows = {"flight": o.samples.flight, "tower": o.samples.tower, "channel": o.samples.channel, "time": time}
    return pd.DataFrame({**rows, "east_m": o.samples.position_m[:, 0], "north_m": o.samples.position_m[:, 1]})


def questions(
    bench: Bench, split: tasks.Split, known: Sequence[str], flight: str
) -> Iterator[tuple[list[LinkSamples], list[LinkSamples]]]:
    """Return the known samples and the targets of each fold of a flight, and the flight itself if needed."""
    tests, train = bench.observed(flight), samples_of(bench, known)
    folds = [tasks.folds_of(split, rows_of(o)) for o in tests]
    for fold in np.unique(np.concatenate(folds)):
        targets = [o.part(numbers == fold) for o, numbers in zip(tests, folds, strict=True)]
        first = rows_of(next(o for o in targets if len(o.samples)))
        own = [] if split == "flights" else [
            o.part(tasks.may_know(split, rows_of(o), first, same_flight=True)) for o in tests
        ]  # fmt: skip
        yield [o.samples for o in (*train, *own) if len(o.samples)], [o.samples for o in targets]


def learned(
    train: Sequence[LinkSamples], titles: Sequence[str] = (), antennas: Sequence[LinkSamples] = ()
) -> Correction:
    """Antennas learned from samples and from those of ``antennas``, with the residual field chosen, or one of some."""
    return choose(train, {"learned": lambda some: learned_antennas([*some, *antennas]).predict}, titles)


def errors(correction: Correction, asked: LinkSamples, known: Sequence[LinkSamples]) -> Part:
    """Compute errors of means over :data:`MEANS_S`.

    If the flight is unknown, the errors are relative to their own mean.
    """
    own = asked.flight not in {s.flight for s in known}
    binned = asked.binned(MEANS_S)
    level, sd = correction.predict(binned, None if own else asked.flight, own_mean=own)
    error = binned.residual_db - level
    return error - own * error.mean(), sd


def both(
    train: Sequence[LinkSamples], asked: Sequence[LinkSamples], antennas: Sequence[LinkSamples] = ()
) -> tuple[str, list[Part], list[Part]]:
    """Return the title of the chosen field, and the errors of each series without a field and with the chosen one."""
    chosen, alone = (learned(train, titles, antennas) for titles in ((), (OFF,)))
    asked = [s for s in asked if len(s) and s.antenna in chosen.channels]
    return chosen.title, *([errors(c, s, train) for s in asked] for c in (alone, chosen))  # type: ignore[return-value]


def rms(parts: Sequence[Part]) -> float:
    """Mean over series of the RMSE."""
    return float(np.mean([np.sqrt(np.mean(error**2)) for error, _ in parts]))


def held(parts: Sequence[Part]) -> float:
    """Per cent of errors inside the 90 % interval."""
    return 100.0 * float(np.mean(np.concatenate([np.abs(error) < 1.645 * sd for error, sd in parts])))


def samples_of(bench: Bench, names: Sequence[str]) -> list[Observed]:
    """Series of some flights."""
    return [o for name in names for o in bench.observed(name)]


def flights(bench: Bench, *, quick: bool) -> None:
    every, rows = samples_of(bench, DATASET12), []
    for name in DATASET12[: 1 if quick else None]:
        train, asked = ([o for o in every if (o.samples.flight == name) == mine] for mine in (False, True))
        model = learned_antennas([o.samples for o in train])
        scores = [result for o in asked if (result := score(o, model.mean(o.samples)))]
        title, alone, chosen = both([o.samples for o in train], [o.samples for o in asked])
        rows.append([*(np.mean([getattr(s, key) for s in scores]) for key in ("rmse_db", "rmse_4s_db")),
                     rms(alone), held(alone), rms(chosen), held(chosen)])  # fmt: skip
        print(line(f"dataset 12, {name} from two", rows[-1]), title)
    print(line("dataset 12, mean of three (goals 3.3, 2.7; 3.0, 87-93 %)", np.mean(rows, axis=0)))


def line(name: str, row: Sequence[float] | FloatArray) -> str:
    said = f"learned {row[0]:.2f} as logged, {row[1]:.2f} over 4 s; 3 s means: learned {row[2]:.3f} ({row[3]:.0f} %)"
    return f"{name}: {said}, with the chosen field {row[4]:.3f} ({row[5]:.0f} %)"


def blocks(bench: Bench, *, quick: bool) -> None:
    cases: list[tuple[str, tuple[str, ...], tuple[str, ...]]] = []
    for test in DATASET12:
        first, second = (name for name in DATASET12 if name != test)
        cases += [(test, (first,), ()), (test, (second,), ()), (test, (first,), (second,)), (test, (first, second), ())]
    table: dict[str, list[list[float]]] = {}
    for test, known, antennas in cases[: 1 if quick else None]:
        row = block_errors(bench, test, known, antennas, every=4 if quick else 1)
        said = f"{' + '.join(known)} known{''.join(f', antennas learned on {name} too' for name in antennas)}"
        print(f"blocks of {test}, {said}: " + BLOCK_LINE.format(*row), flush=True)
        table.setdefault(f"{len(known)} known, antennas of {len(known + antennas)}", []).append(row)
    for title, rows in table.items():
        print(f"blocks, mean of {len(rows)}, {title} (goal 3.0): " + BLOCK_LINE.format(*np.mean(rows, axis=0)))


def block_errors(
    bench: Bench, test: str, known: Sequence[str], antennas: Sequence[str], *, every: int = 1
) -> list[float]:
    """Compute the numbers of :data:`BLOCK_LINE` for every n-th block of a flight.

    ``antennas`` are flights from which only antennas are learned.
    """
    extra = [o.samples for o in samples_of(bench, antennas)]
    answers = [both(*fold, extra) for fold in list(questions(bench, "blocks", known, test))[::every]]
    row = []
    for k in (1, 2):  # blocks of one series are one series again
        series = zip(*(answer[k] for answer in answers), strict=True)
        parts = [(np.concatenate(error), np.concatenate(sd)) for error, sd in (zip(*s, strict=True) for s in series)]
        row += [rms(parts), rms([(error - error.mean(), sd) for error, sd in parts]), held(parts)]
    return [*row, 100.0 * float(np.mean([answer[0] != OFF for answer in answers]))]


def at_height(bench: Bench, name: str) -> Observed:
    """The series of a flight at one height, from its first sample there to its last."""
    (flown,) = bench.observed(name)
    up = flown.samples.position_m[:, 2]
    high = np.flatnonzero(up > np.median(up) - 0.5)
    return flown.part(np.arange(high[0], high[-1] + 1))


def lte_height(bench: Bench, name: str, other: str, *, repeats: int) -> dict[str, tuple[float, ...]]:
    """Numbers of :func:`protocol` of one height, by model."""
    known = {end: gain_of(AntennaSettings(model="file", file=f"{file}_F3500.txt"), bench.folder / "antennas")
             for end, file in (("uav", "SA-1400-5900"), ("tower", "RM-WB1-DN-BLK_right_side_up"))}  # fmt: skip
    asked, (train,) = at_height(bench, name), bench.observed(other)
    tower = bench.flight(name).site.towers[asked.samples.tower]
    model = learned_antennas([train.samples])

    def two_ray(o: Observed) -> FloatArray:
        level = two_ray_dbm(tower.position_m[None, :], o.samples.position_m, 3.51e9, ground_m=tower.ground_m)[:, 0]
        return level - o.free_space_db + known["uav"](o.samples.at_uav) + known["tower"](o.samples.at_tower)

    bases: dict[str, Callable[[Observed], FloatArray]] = {
        "free space": lambda o: np.zeros(len(o.samples)), "two-ray + patterns": two_ray,
        "learned": lambda o: model.mean(o.samples),
    }  # fmt: skip
    rng = np.random.default_rng(3)
    draws = [rng.choice(len(asked.samples), 200 + TARGETS, replace=False) for _ in range(repeats)]
    return {base: protocol(asked, train, gain, draws, learned=base == "learned") for base, gain in bases.items()}


def lte(bench: Bench, *, quick: bool) -> None:
    rows: list[dict[str, tuple[float, ...]]] = []
    for name, other in (LTE, LTE[::-1])[: 1 if quick else None]:
        row = lte_height(bench, name, other, repeats=20 if quick else 300)
        rest = whole_flight(at_height(bench, name), bench.observed(other)[0], quick)
        row["learned, all but 20 s"] = (float(np.sqrt(np.mean(rest**2))),)
        print(f"LTE {name} from {other}:", lte_line(row), flush=True)
        rows.append(row)
    print("LTE, mean (goal 5.4 at M = 50):", lte_line({base: np.mean([r[base] for r in rows], axis=0) for base in row}))


def lte_line(row: Mapping[str, Sequence[float]]) -> str:
    return "; ".join(
        f"{base} M 50 {v[0]:.2f} ({v[1]:.2f}), M 200 {v[2]:.2f} ({v[3]:.2f})" if len(v) > 1 else f"{base} {v[0]:.2f}"
        for base, v in row.items()
    )


def protocol(
    asked: Observed, train: Observed, gain: Callable[[Observed], FloatArray], draws: list, *, learned: bool
) -> tuple[float, ...]:
    """Errors of ordinary Kriging of what a base leaves, from M = 50 and 200 samples: RMSE and median over draws."""
    left = [o.samples.residual_db - gain(o) for o in (train, asked)]
    rows = [Rows.of(o.samples, 0) for o in (train, asked)]
    fading, _ = fading_of([train.samples], BIN_S)
    if learned:  # what it leaves where it learned says nothing
        model = FieldModel(place_sd_db=2.0, turn=np.inf, drift_sd_db=1e-3, noise_sd_db=fading)
    else:
        some = slice(None, None, max(1, len(left[0]) // 600))
        start = FieldModel(place_sd_db=3.0, length_m=100.0, turn=np.inf, drift_sd_db=1e-3, noise_sd_db=fading)
        model = fit_field([(rows[0].part(some), left[0][some])], start, ("place_sd_db", "length_m", "noise_sd_db"))
    out: list[float] = []
    for count in (50, 200):
        error = [left[1][d[200:]] - FieldFit(model, rows[1].part(d[:count]), left[1][d[:count]]).predict(
            rows[1].part(d[200:]))[0] for d in draws]  # fmt: skip
        square = np.mean(np.square(error), axis=1)
        out += [float(np.sqrt(square.mean())), float(np.median(np.sqrt(square)))]
    return tuple(out)


def whole_flight(asked: Observed, train: Observed, quick: bool) -> FloatArray:
    """Return errors if the complete flight is known except 30 s and :data:`GUARD_S` around them."""
    samples, out = asked.samples, []
    for start in np.arange(0.0, samples.time_s[-1], 30.0)[:: 30 if quick else 1]:
        away = np.abs(samples.time_s - start - 15.0)
        own = samples.part(away > 15.0 + GUARD_S)
        model = learned_antennas([train.samples, own])
        target = samples.part(away <= 15.0)
        out.append(target.residual_db - model.mean(target) - model.mean_error(own))
    return np.concatenate(out)


def folds(bench: Bench, names: Sequence[str]) -> Iterator[tuple[list[LinkSamples], list[LinkSamples]]]:
    """Return each flight and the other flights. Of a single flight, take eighths of its time."""
    for name in names:
        others = [other for other in names if other != name]
        yield from questions(bench, "flights" if others else "stretches", others, name)


def crps(bench: Bench, *, quick: bool) -> None:
    place = next(bench.folder.glob("**/flight1_rsrp.kml.gz")).resolve()
    bench.manifest.flights["nr_rsrp"] = NR
    bench.places["nr_rsrp"] = place
    sets = {"dataset 12": DATASET12, "LTE": LTE, "AFAR and sounder": AFAR, "AADM": ("aadm_2025_05_24",),
            "NR RSRP": ("nr_rsrp",)}  # fmt: skip
    for name, names in list(sets.items())[:: 4 if quick else 1]:
        every = list(folds(bench, names))[:: 1 if len(names) > 1 else 2]  # of the eighths every second
        answers = [both(*fold) for fold in every[: 1 if quick else None]]
        parts = [[part for answer in answers for part in answer[k]] for k in (1, 2)]
        values = [np.mean(np.concatenate([crps_normal(*part) for part in each])) for each in parts]
        on = [answer[0] for answer in answers if answer[0] != OFF]
        print(f"{name}: CRPS {values[0]:.3f} learned, {values[1]:.3f} as chosen; RMSE {rms(parts[0]):.2f}, "
              f"{rms(parts[1]):.2f}; 90 % holds {held(parts[0]):.0f}, {held(parts[1]):.0f} %; field on in {len(on)} of "
              f"{len(answers)}", flush=True)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Reports:
    """Rank reports: place (n, 3) [m], time (n,) [s], one-hot rank and logit of the receiver (n, 4)."""

    place: FloatArray
    time: FloatArray
    was: FloatArray
    logit: FloatArray

    @classmethod
    def of(cls, item: RankSamples, receiver: FittedReceiver, every: int) -> Reports:
        rows, logit = slice(None, None, every), np.log(receiver.forecast(item)[0])
        place = item.poses.position_m * [1.0, 1.0, HEIGHT_COUNTS]
        was = np.eye(4)[item.rank.astype(int) - 1]
        return cls(place=place[rows], time=item.time_s[rows], was=was[rows], logit=logit[rows])

    def part(self, rows: BoolArray) -> Reports:
        return Reports(place=self.place[rows], time=self.time[rows], was=self.was[rows], logit=self.logit[rows])

    def lost(self, known: Reports, terms: Sequence[tuple[float, float]]) -> FloatArray:
        """Log loss (n,) with a field learned on other reports."""
        own, cross = (
            sum(strength**2 * np.exp(-cdist(reports.place, known.place) / length) for length, strength in terms)
            for reports in (known, self)
        )
        shifted = self.logit + cross @ logistic(own, known.logit, known.was)
        return np.asarray(-(self.was * log_softmax(shifted, axis=1)).sum(axis=1))


def rank_parts(own: Reports, taught: Reports) -> dict[str, list[tuple[Reports, Reports]]]:
    """Reports that are asked for and those that are known, by what is known, in time order."""
    step = np.append(0.0, np.linalg.norm(np.diff(own.place, axis=0), axis=1))
    block = np.floor(np.cumsum(step) / 300.0)
    rest = []
    for number in np.unique(block):
        inside = block == number
        apart_s = np.abs(own.time[:, None] - own.time[inside]).min(axis=1)
        rest.append((own.part(inside), own.part(apart_s > GUARD_S)))
    ahead = [(own.part((own.time > start) & (own.time <= start + AHEAD_S)), own.part(own.time <= start))
             for start in np.arange(own.time[0] + FIRST_S, own.time[-1], AHEAD_S)]  # fmt: skip
    return {
        "the rest of the flight known": rest,
        f"{AHEAD_S:.0f} s ahead": ahead,
        "the other flight known": [(own, taught)],
    }


def ranks(bench: Bench, *, quick: bool) -> None:
    names = "nr_flight1", "nr_flight3"
    for test, train in (names, names[::-1])[: 1 if quick else None]:
        (teacher,), (item,) = bench.ranks(train), bench.ranks(test)
        receiver = Tried.of([teacher]).fit([0])
        own, taught = (Reports.of(reports, receiver, 20 if quick else 2) for reports in (item, teacher))
        for title, parts in rank_parts(own, taught).items():
            alone = np.concatenate([-(asked.was * asked.logit).sum(axis=1) for asked, _ in parts])
            print(f"ranks of {test}, receiver of {train}, {title}: log score {alone.mean():.3f} alone", flush=True)
            for name, terms in RANK_FIELDS.items():
                lost = np.concatenate([asked.lost(known, terms) for asked, known in parts])
                low, high = mean_interval(lost - alone)
                print(f"  {name}: {lost.mean():.3f}, {(lost - alone).mean():+.3f} (95 %: {low:+.3f} to {high:+.3f})")


def logistic(kernel: FloatArray, logit: FloatArray, was: FloatArray) -> FloatArray:
    """Weights (n, 4) of the likeliest field on logits (n, 4), given one-hot reports: report minus share."""
    lower = np.linalg.cholesky(kernel + 1e-6 * np.eye(len(kernel)))

    def share(white: FloatArray) -> FloatArray:
        return logit + lower @ white.reshape(logit.shape)

    def loss(white: FloatArray) -> tuple[float, FloatArray]:
        score = log_softmax(share(white), axis=1)
        gradient = lower.T @ (np.exp(score) - was)
        return float(0.5 * white @ white - (was * score).sum()), white + gradient.ravel()

    best = minimize(loss, np.zeros(logit.size), jac=True, method="L-BFGS-B").x
    return np.asarray(was - softmax(share(best), axis=1))


PARTS = {"flights": flights, "blocks": blocks, "lte": lte, "crps": crps, "ranks": ranks}


def main() -> None:
    """Print each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--quick", action="store_true", help="a part of each")
    asked = parser.parse_args()
    folder = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if not folder:
        raise SystemExit("AERPAW_CMP_FIELD_DATA does not name the folder of the real logs")
    bench = Bench(Path(folder))
    for name in asked.only:
        PARTS[name](bench, quick=asked.quick)


if __name__ == "__main__":
    main()
