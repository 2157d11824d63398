"""Learned antennas and their residual field on real flights: errors and intervals where nothing was learned.

``flights``: dataset 12, each flight from the other two. ``blocks``: 300 m blocks (and 20 m around them) of each flight,
the rest of it known and another flight, or both. ``lte``: 25 of a flight's samples from M others by the protocol of the
data's authors, the other height known; 300 draws; last, all of the flight known but 20 s about the target. ``crps``:
with the residual field and without, each flight left out, or the eighths of a single one; the field is chosen inside
what is known. ``ranks``: log score of the receiver that another flight taught, alone and with a residual field on its
logits (a kernel logistic, learned on the rest of the flight), in 300 m of the flight left out, for each strength.

    AERPAW_CMP_FIELD_DATA=... python benchmarks/learned_map.py [--only flights blocks lte crps ranks] [--quick]
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from aerpaw_cmp.common.units import FloatArray
from aerpaw_cmp.compare.direction_gain import LinkSamples
from aerpaw_cmp.compare.entries import crps_normal
from aerpaw_cmp.compare.learning.calibration import Observed, score
from aerpaw_cmp.compare.learning.correction import BIN_S, OFF, Correction, choose
from aerpaw_cmp.compare.learning.field_gp import FieldFit, FieldModel, Rows, fit_field
from aerpaw_cmp.compare.spread import fading_of
from aerpaw_cmp.flight.settings import AntennaSettings
from aerpaw_cmp.jobs.benchmarks.benchmark import Bench, Task, load_manifest, questions
from aerpaw_cmp.jobs.benchmarks.entrants import RANK
from aerpaw_cmp.jobs.learning.calibrate import gain_of, learned_antennas
from aerpaw_cmp.propagation.field.baselines import two_ray_dbm

DATASET12 = ("40m_fs10MHz", "40m_fs5MHz", "70m_fs20MHz")
LTE = ("lte_plotdata2", "lte_plotdata4")
AFAR = ("afar_300_loc_1", "afar_300_loc_2", "afar_309_loc_2", "afar_328_loc_1", "afar_328_loc_3", "afar_288_loc_1")
NR = {
    "timezone": "America/New_York",
    "site": {"file": "lake_wheeler", "coordinates": "A", "without_buildings": True},
    "logs": [{"path": "nr_rsrp", "node": "LW1"}],
    "link": {"rss": {"carrier_hz": 3.4e9}},
}
"""Its levels are no task of the benchmark: one flight of the folder has them with positions."""
MEANS_S, TARGETS, GUARD_S = 3.0, 25, 20.0
RANK_FIELDS = [(length, strength) for length in (15.0, 40.0, 100.0) for strength in (0.3, 0.6, 1.0)]
"""Length over place [m] and strength of the residual field on a receiver's logits."""
HEIGHT_COUNTS = 2.0
"""Times as far as places."""
Part = tuple[FloatArray, FloatArray]
"""Errors and stated standard deviations (n,) [dB]."""


def learned(train: Sequence[LinkSamples], titles: Sequence[str] = ()) -> Correction:
    """Antennas learned from samples, with the residual field that they choose, or one of some."""
    return choose(train, {"learned": lambda some: learned_antennas(some).predict}, titles)


def errors(correction: Correction, asked: LinkSamples, known: Sequence[LinkSamples]) -> Part:
    """Errors over means of :data:`MEANS_S`; about their own mean where the flight is not known."""
    own = asked.flight not in {s.flight for s in known}
    binned = asked.binned(MEANS_S)
    level, sd = correction.predict(binned, None if own else asked.flight, own_mean=own)
    error = binned.residual_db - level
    return error - own * error.mean(), sd


def both(train: Sequence[LinkSamples], asked: Sequence[LinkSamples]) -> tuple[str, list[Part], list[Part]]:
    """Title of the chosen field; errors of each series without a field and with the chosen one."""
    chosen, alone = learned(train), learned(train, (OFF,))
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
        scores = [one for o in asked if (one := score(o, model.mean(o.samples)))]
        title, alone, chosen = both([o.samples for o in train], [o.samples for o in asked])
        rows.append([*(np.mean([getattr(s, key) for s in scores]) for key in ("rmse_db", "rmse_4s_db")),
                     rms(alone), held(alone), rms(chosen), held(chosen)])  # fmt: skip
        print(line(f"dataset 12, {name} from two", rows[-1]), title)
    print(line("dataset 12, mean of three (goals 3.3, 2.7; 3.0, 87-93 %)", np.mean(rows, axis=0)))


def line(name: str, row: Sequence[float] | FloatArray) -> str:
    said = f"learned {row[0]:.2f} as logged, {row[1]:.2f} over 4 s; 3 s means: learned {row[2]:.3f} ({row[3]:.0f} %)"
    return f"{name}: {said}, with the chosen field {row[4]:.3f} ({row[5]:.0f} %)"


def blocks(bench: Bench, *, quick: bool) -> None:
    pairs = [(test, (known,)) for test in DATASET12 for known in DATASET12 if known != test]
    cases = pairs[:1] if quick else pairs + [(one, tuple(o for o in DATASET12 if o != one)) for one in DATASET12]
    table: dict[int, list[tuple[float, ...]]] = {}
    for test, known in cases:
        bench.manifest.tasks["block"] = Task(title="", split="blocks", train=list(known), test=[test])
        asked = list(questions(bench, "block", test))[:: 4 if quick else 1]
        found = [both([o.samples for o in q.train], [o.samples for o in q.asked]) for q in asked]
        row = []
        for k in (1, 2):  # blocks of one series are one series again
            series = zip(*(one[k] for one in found), strict=True)
            parts = [tuple(map(np.concatenate, zip(*each, strict=True))) for each in series]
            row += [rms(parts), held(parts)]  # type: ignore[arg-type]
        on = sum(one[0] != OFF for one in found)
        print(f"blocks of {test}, known {' + '.join(known)}: learned {row[0]:.3f} ({row[1]:.0f} %), with the chosen "
              f"field {row[2]:.3f} ({row[3]:.0f} %), on in {on} of {len(found)}", flush=True)  # fmt: skip
        table.setdefault(len(known), []).append(tuple(row))
    for count, rows in table.items():
        mean = np.mean(rows, axis=0)
        print(f"blocks, mean of {len(rows)}, {count} known (goal 3.0): {mean[0]:.3f}, with the field {mean[2]:.3f}")


def lte_height(bench: Bench, name: str, other: str, *, repeats: int) -> dict[str, tuple[float, ...]]:
    """RMSE of one height with M = 50 and 200 samples, by model."""
    known = {end: gain_of(AntennaSettings(model="file", file=f"{file}_F3500.txt"), bench.folder / "antennas")
             for end, file in (("uav", "SA-1400-5900"), ("tower", "RM-WB1-DN-BLK_right_side_up"))}  # fmt: skip
    (asked,), (train,) = (bench.observed(one) for one in (name, other))
    tower = bench.data(name).site.towers[asked.samples.tower]
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
    means = []
    for name, other in (LTE, LTE[::-1])[: 1 if quick else None]:
        row = lte_height(bench, name, other, repeats=20 if quick else 300)
        (asked,), (train,) = (bench.observed(one) for one in (name, other))
        row["learned, all but 20 s"] = (float(np.sqrt(np.mean(whole_flight(asked, train, quick) ** 2))),)
        said = (f"{base} " + ", ".join(f"{value:.2f}" for value in values) for base, values in row.items())
        print(f"LTE {name} from {other}:", "; ".join(said), flush=True)
        means.append(np.concatenate(list(row.values())))
    print("LTE, mean (M = 50, 200 of each; goal 5.4 at 50):", np.round(np.mean(means, axis=0), 2).tolist())


def protocol(
    asked: Observed, train: Observed, gain: Callable[[Observed], FloatArray], draws: list, *, learned: bool
) -> tuple[float, ...]:
    """RMSE with M = 50 and 200 samples: ordinary Kriging of what a base leaves, its scales from the other height."""
    left = [o.samples.residual_db - gain(o) for o in (train, asked)]
    rows = [Rows.of(o.samples, 0) for o in (train, asked)]
    fading, _ = fading_of([train.samples], BIN_S)
    if learned:  # what it leaves where it learned says nothing
        model = FieldModel(place_sd_db=2.0, turn=np.inf, drift_sd_db=1e-3, noise_sd_db=fading)
    else:
        some = slice(None, None, max(1, len(left[0]) // 600))
        start = FieldModel(place_sd_db=3.0, length_m=100.0, turn=np.inf, drift_sd_db=1e-3, noise_sd_db=fading)
        model = fit_field([(rows[0].part(some), left[0][some])], start, ("place_sd_db", "length_m", "noise_sd_db"))
    out = []
    for count in (50, 200):
        error = [left[1][d[200:]] - FieldFit(model, rows[1].part(d[:count]), left[1][d[:count]]).predict(
            rows[1].part(d[200:]))[0] for d in draws]  # fmt: skip
        out.append(float(np.sqrt(np.mean(np.square(error)))))
    return tuple(out)


def whole_flight(asked: Observed, train: Observed, quick: bool) -> FloatArray:
    """Errors where all of the flight is known but a stretch of 30 s and :data:`GUARD_S` about it."""
    samples, out = asked.samples, []
    for start in np.arange(0.0, samples.time_s[-1], 30.0)[:: 30 if quick else 1]:
        away = np.abs(samples.time_s - start - 15.0)
        own = samples.part(away > 15.0 + GUARD_S)
        model = learned_antennas([train.samples, own])
        target = samples.part(away <= 15.0)
        out.append(target.residual_db - model.mean(target) - model.mean_error(own))
    return np.concatenate(out)


def folds(bench: Bench, names: Sequence[str]) -> Iterator[tuple[list[LinkSamples], list[LinkSamples]]]:
    """Each flight and the others; of a single flight, eighths of its time and the rest but 20 s."""
    split = "flights" if len(names) > 1 else "stretches"
    for name in names:
        others = [other for other in names if other != name]
        bench.manifest.tasks["fold"] = Task(title="", split=split, train=others, test=[name])
        for one in questions(bench, "fold", name):
            yield [o.samples for o in one.train], [o.samples for o in one.asked]


def crps(bench: Bench, *, quick: bool) -> None:
    place = next(bench.folder.glob("**/flight1_rsrp.kml.gz")).resolve()
    bench.manifest.flights["nr_rsrp"] = NR
    bench.places["nr_rsrp"] = place
    sets = {"dataset 12": DATASET12, "LTE": LTE, "AFAR and sounder": AFAR, "AADM": ("aadm_2025_05_24",),
            "NR RSRP": ("nr_rsrp",)}  # fmt: skip
    for name, names in list(sets.items())[:: 4 if quick else 1]:
        every = list(folds(bench, names))[:: 1 if len(names) > 1 else 2]  # of the eighths every second
        found = [both(*fold) for fold in every[: 1 if quick else None]]
        parts = [[part for one in found for part in one[k]] for k in (1, 2)]
        values = [np.mean(np.concatenate([crps_normal(*part) for part in each])) for each in parts]
        on = [one[0] for one in found if one[0] != OFF]
        print(f"{name}: CRPS {values[0]:.3f} learned, {values[1]:.3f} as chosen; RMSE {rms(parts[0]):.2f}, "
              f"{rms(parts[1]):.2f}; 90 % holds {held(parts[0]):.0f}, {held(parts[1]):.0f} %; field on in {len(on)} of "
              f"{len(found)}", flush=True)  # fmt: skip


def ranks(bench: Bench, *, quick: bool) -> None:
    names = "nr_flight1", "nr_flight3"
    for test, train in (names, names[::-1])[: 1 if quick else None]:
        (item,), (receiver,) = bench.ranks(test), RANK["learned"](bench, [train], test)
        rows = np.flatnonzero(item.rank >= 1)[:: 20 if quick else 2]
        place, time = item.poses.position_m[rows] * [1.0, 1.0, HEIGHT_COUNTS], item.time_s[rows]
        was, logit = np.eye(4)[item.rank[rows].astype(int) - 1], np.log(receiver[rows])
        step = np.append(0.0, np.linalg.norm(np.diff(item.poses.position_m[rows], axis=0), axis=1))
        block = np.floor(np.cumsum(step) / 300.0)
        scores = [-np.mean((was * logit).sum(axis=1))]
        for length, strength in RANK_FIELDS[: 1 if quick else None]:
            kernel = strength**2 * np.exp(-np.linalg.norm(place[:, None] - place, axis=2) / length)
            lost = np.empty(len(rows))
            for asked in (block == one for one in np.unique(block)):
                away = np.abs(time[:, None] - time[asked]).min(axis=1) > GUARD_S
                weight = logistic(kernel[np.ix_(away, away)], logit[away], was[away])
                lost[asked] = -(was * log_softmax(logit + kernel[:, away] @ weight, axis=1)).sum(axis=1)[asked]
            scores.append(lost.mean())
        print(f"ranks of {test}, receiver of {train}: log score {scores[0]:.3f} alone; with a field", *(
            f"of {strength} over {length:.0f} m {score:.3f}," for (length, strength), score in
            zip(RANK_FIELDS, scores[1:], strict=False)), flush=True)  # fmt: skip


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
    bench = Bench(load_manifest(), Path(folder))
    for name in asked.only:
        PARTS[name](bench, quick=asked.quick)


if __name__ == "__main__":
    main()
