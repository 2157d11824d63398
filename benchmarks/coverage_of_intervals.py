"""How often the stated 95 % intervals hold the truth, and how often a pooled verdict is false, on simulated flights.

Each flight has shadowing of one kind: rough (AR(1)) or smooth (AR(2)), with white noise, heavy tails (Student's t of
four degrees of freedom), uneven spacing or a gap. Two tables:

* offset and RMSE of one channel: share of intervals that hold the mean of the process and the RMSE that such flights
  have on average; median width over that of an interval of someone who knows the memory. Coverage is to be 92-97 %:
  kinds that might lie on either side of a bound, by the Wilson interval of their own count, fly :data:`NEAR` times as
  often. Where a flight holds 20 memories and more, the ratio of widths is to be at most 1.5.
* two models over ten channels (4 dB): false verdicts on equal models, whose errors are random or whose predictions
  differ along a route; power where the truth is 0.3 dB; the same of someone who knows the spread; flights on which a
  channel is called better or worse, corrected for their number. And coverage where one model is right.

The first comes twice: of the kinds that the weights are fitted to, and of kinds between them. Ranks come from
thresholds on two shadowing processes. ``--only sample``: levels of the sample flight, redrawn about its replay, with
the noise of its plan, and the share of draws whose verdict against the best baseline excludes zero.

    python benchmarks/coverage_of_intervals.py [--flights 200] [--json] [--only level|between|pooled|rank|sample]
"""

import argparse
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from scipy.stats import binomtest, multivariate_normal, norm

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.compare.rank import compare_ranks
from aerpaw_cmp.compare.statistics import (
    PairedDifference,
    corrected,
    mean_interval,
    paired_difference,
    pooled_difference,
    spread_interval,
)
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.flight.simulate import correlated_noise
from aerpaw_cmp.jobs.flight_run import run_flight

SHADOW_DB, CHANNELS, APART_DB = 4.0, 10, 0.3
CUTS = np.array([-0.8, 0.5, 1.6])
ASKED, NEAR = (0.92, 0.97), 8


@dataclass(frozen=True)
class Shadowing:
    """A kind of flight: ``roots`` of the autoregression, white noise over the standard deviation of the rest."""

    n: int
    roots: tuple[float, ...] = ()
    noise: float = 0.0
    tails: int | None = None
    spacing: str = "even"

    def __str__(self) -> str:
        kind = {0: "white", 1: "AR(1)", 2: "AR(2)"}[len(self.roots)]
        parts = [" ".join([f"{self.n}: {kind}", *(f"{root:.4g}" for root in self.roots)])]
        parts += [f"noise {self.noise:g}"] if self.noise else []
        parts += [f"t{self.tails}"] if self.tails else []
        return ", ".join([*parts, *([self.spacing] if self.spacing != "even" else [])])

    @property
    def memories(self) -> float:
        """Memories that the flight holds."""
        return self.n * (1.0 - max(self.roots, default=0.0))

    @cached_property
    def places(self) -> IntArray:
        """Instants (n,) at which the process is sampled."""
        if self.spacing == "uneven":
            return np.sort(np.random.default_rng(3).choice(4 * self.n, self.n, replace=False))
        gap = self.n // 2 if self.spacing == "gap" else 0
        return np.arange(self.n) + np.where(np.arange(self.n) < self.n // 3, 0, gap)

    @cached_property
    def response(self) -> FloatArray:
        """Levels that one drive adds to the instants after it."""
        length = int(min(40.0 / (1.0 - max(self.roots, default=0.0)), 2e5))
        impulse = lfilter([1.0], np.poly(self.roots), np.eye(1, length)[0]) if self.roots else np.ones(1)
        return impulse / np.sqrt((impulse**2).sum())

    @property
    def in_flight_variance(self) -> float:
        """Mean square about its own mean that such flights have on average."""
        reach, length = int(self.places[-1]) + 1, len(self.response)
        size = 1 << (2 * max(reach, length)).bit_length()
        covariance = np.fft.irfft(np.abs(np.fft.rfft(self.response, size)) ** 2, size)[:reach]
        apart = np.bincount(np.abs(self.places[:, None] - self.places).ravel(), minlength=reach)
        return float(1.0 - covariance @ apart / self.n**2 + self.noise**2 * (1.0 - 1.0 / self.n))

    def sequences(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Errors (count, n): unit variance, and noise."""

        def drawn(*shape: int) -> FloatArray:
            if self.tails is None:
                return rng.normal(size=shape)
            return rng.standard_t(self.tails, size=shape) / np.sqrt(self.tails / (self.tails - 2.0))

        long = int(self.places[-1]) + 1
        if len(self.roots) == 1:
            drive = drawn(count, long) * np.sqrt(1.0 - self.roots[0] ** 2)
            drive[:, 0] /= np.sqrt(1.0 - self.roots[0] ** 2)
            x = lfilter([1.0], [1.0, -self.roots[0]], drive, axis=1)
        else:
            settled = int(12.0 / (1.0 - max(self.roots, default=0.0)))
            scale = self.response[0]
            x = lfilter([1.0], np.poly(self.roots), scale * drawn(count, settled + long), axis=1)[:, settled:]
        return np.asarray(x[:, self.places] + self.noise * drawn(count, self.n))


SIZES, CORRELATIONS = (60, 100, 200, 300, 500, 1000, 2000, 3000), (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99)
GRID = tuple(
    [Shadowing(n, (r,) if r else ()) for n in SIZES for r in CORRELATIONS]
    + [Shadowing(n, (float(np.exp(-0.5 / n)),)) for n in SIZES]  # a memory of two flights
    + [Shadowing(n, (r,), noise) for n in (200, 500, 1000, 3000) for r, noise in ((0.9, 0.5), (0.98, 0.5), (0.98, 2.0))]
    + [Shadowing(n, (r,), noise) for n in (60, 100) for r, noise in ((0.8, 1.0), (0.9, 0.5))]
    + [
        Shadowing(n, r)
        for n in (60, 100, 200, 300, 1000, 3000)
        for r in ((0.8, 0.8), (0.9, 0.9), (0.97, 0.97), (0.97, 0.5))
    ]
    + [Shadowing(n, r, 0.0, 4) for n in (100, 300, 1000) for r in ((), (0.9,))]
    + [Shadowing(n, (r,), 0.0, None, s) for n in (300, 1000) for r in (0.9, 0.98) for s in ("uneven", "gap")]
)
# Between those of the grid, which the weights are fitted to.
BETWEEN = tuple(
    [Shadowing(n, (r,)) for n in (80, 150, 700, 1500) for r in (0.3, 0.7, 0.93, 0.97, float(np.exp(-1.0 / n)))]
    + [Shadowing(n, (r,), noise) for n in (150, 700, 1500) for r, noise in ((0.7, 1), (0.97, 0.3), (0.98, 2))]
    + [Shadowing(n, r) for n in (150, 700) for r in ((0.85, 0.85), (0.95, 0.95), (0.95, 0.6))]
    + [Shadowing(n, r, 0.0, 5) for n in (150, 700) for r in ((), (0.7,), (0.93,))]
    + [Shadowing(700, (r,), 0.0, None, s) for r in (0.93, 0.97) for s in ("uneven", "gap")]
)
POOLED = (
    *(Shadowing(n, (r,) if r else ()) for n in (300, 1000) for r in CORRELATIONS[:-1]),
    Shadowing(1000, (0.9,), 0.5), Shadowing(1000, (0.9,), 0.0, 4), Shadowing(1000, (0.9, 0.9)),
    Shadowing(1000, (0.9,), 0.0, None, "gap"),
)  # fmt: skip


def shadowed_pair(
    rng: np.random.Generator, shadowing: Shadowing, count: int, channels: int = CHANNELS, *,
    larger: float = 1.0, shared: float = 0.0,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Errors (count, n x channels) of two models that share half of their shadowing, the first ``larger`` times.

    Samples of one instant stand together; ``shared`` is the part that all channels have in common.
    """
    both = [shadowing.sequences(rng, count) for _ in range(2)] if shared else [0.0, 0.0]
    columns = []
    for _ in range(channels):
        own, other = (
            np.sqrt(shared) * common + np.sqrt(1.0 - shared) * shadowing.sequences(rng, count) for common in both
        )
        columns.append((larger * own, 0.5 * own + np.sqrt(0.75) * other))
    return _together(columns)


def routed_pair(
    rng: np.random.Generator, shadowing: Shadowing, count: int, channels: int, b: float
) -> tuple[FloatArray, FloatArray]:
    """The same where the predictions differ along a route and the measurement lies the share ``b`` between them."""
    columns = []
    for channel in range(channels):
        phase, route = np.linspace(0.0, 2.0 * np.pi, shadowing.n), np.random.default_rng(channel)
        apart = 0.5 * sum(
            route.normal() * np.sin(k * phase + route.uniform(0.0, 6.0)) / np.sqrt(k) for k in (1, 2, 3, 5, 8, 13, 21)
        )
        noise = shadowing.sequences(rng, count)
        columns.append((b * apart + noise, (b - 1.0) * apart + noise))
    return _together(columns)


def _together(columns: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    first, second = (
        np.stack([e - e.mean(axis=1, keepdims=True) for e in model], axis=2) for model in zip(*columns, strict=True)
    )
    return first.reshape(len(first), -1), second.reshape(len(second), -1)


def wilson(share: float, flights: int) -> tuple[float, float]:
    """95 % interval of a coverage that was counted on so many flights."""
    return binomtest(round(share * flights), flights).proportion_ci(method="wilson")


def level_cell(shadowing: Shadowing, flights: int) -> dict[str, object]:
    """Coverage and width of offset and RMSE."""
    rng = np.random.default_rng([shadowing.n, *str(shadowing).encode()])
    truth = SHADOW_DB * np.sqrt(shadowing.in_flight_variance)
    ends = np.empty((0, 2, 2))
    for more in (flights, (NEAR - 1) * flights):
        errors = SHADOW_DB * shadowing.sequences(rng, more)
        ends = np.concatenate([ends, [[mean_interval(e), spread_interval(e)] for e in errors]])
        held = ((ends[..., 0] <= (0.0, truth)) & ((0.0, truth) <= ends[..., 1])).mean(axis=0)
        if not any(low < bound < high for low, high in (wilson(share, more) for share in held) for bound in ASKED):
            break
    many = SHADOW_DB * shadowing.sequences(rng, 2000)
    low, high = np.quantile(many.std(axis=1) / truth, [0.025, 0.975])
    known = 3.92 * many.mean(axis=1).std(), truth * (1.0 / low - 1.0 / high)
    width = np.median(np.where(np.isfinite(ends), ends, np.inf)[..., 1] - ends[..., 0], axis=0)
    return {
        "flight": str(shadowing), "flights": len(ends), "memories": shadowing.memories,
        **{f"{name}_{what}": float(value) for name, i in (("offset", 0), ("rmse", 1))
           for what, value in (("coverage", held[i]), ("width_ratio", width[i] / known[i]))},
    }  # fmt: skip


def pooled_cell(shadowing: Shadowing, flights: int) -> dict[str, object]:
    """False verdicts, power and coverage of two models over ten channels."""
    rng = np.random.default_rng([shadowing.n, 7, POOLED.index(shadowing)])
    time = np.arange(shadowing.n)

    def pooled(pair: tuple[FloatArray, FloatArray]) -> list[PairedDifference]:
        channels = (e.reshape(flights, shadowing.n, CHANNELS) for e in pair)
        return [
            pooled_difference([(time, SHADOW_DB * a, SHADOW_DB * b) for a, b in zip(first.T, second.T, strict=True)])
            for first, second in zip(*channels, strict=True)
        ]

    def decided(pairs: list[PairedDifference]) -> float:
        return float(np.mean([pair.verdict in ("better", "worse") for pair in pairs]))

    equal = shadowed_pair(rng, shadowing, flights)
    known = 1.96 * np.std([pair.mean_square_difference_db2 for pair in pooled(equal)])
    size = np.sqrt(1.0 + shadowing.noise**2)
    better = pooled(shadowed_pair(rng, shadowing, flights, larger=1.0 + APART_DB / SHADOW_DB / size))
    right = pooled(routed_pair(rng, shadowing, flights, CHANNELS, 0.0))
    by_channel = [
        corrected([paired_difference(a, b) for a, b in zip(first.T, second.T, strict=True)])
        for first, second in zip(*(e.reshape(flights, shadowing.n, CHANNELS) for e in equal), strict=True)
    ]
    return {
        "flight": str(shadowing),
        "false": decided(pooled(equal)),
        "false_shared": decided(pooled(shadowed_pair(rng, shadowing, flights, shared=0.5))),
        "false_route": decided(pooled(routed_pair(rng, shadowing, flights, CHANNELS, 0.5))),
        "power": decided(better),
        "power_known": float(np.mean([abs(pair.mean_square_difference_db2) > known for pair in better])),
        "right_decided": decided(right),
        "any_channel": float(np.mean([any(pair.verdict in ("better", "worse") for pair in row) for row in by_channel])),
    }


def rank_truth(mix: float) -> dict[str, float]:
    """Agreement, kappa, total variation and first bar of two thresholded unit normals with correlation ``mix``."""
    edges = np.concatenate([[-8.0], CUTS, [8.0]])
    shifted = np.concatenate([[-8.0], CUTS + 0.3, [8.0]])
    pair = multivariate_normal([0, 0], [[1, mix], [mix, 1]])

    def box(a: float, b: float, c: float, d: float) -> float:
        return float(pair.cdf([b, d]) - pair.cdf([a, d]) - pair.cdf([b, c]) + pair.cdf([a, c]))

    agree = sum(box(edges[i], edges[i + 1], shifted[i], shifted[i + 1]) for i in range(4))
    p, q = np.diff(norm.cdf(edges)), np.diff(norm.cdf(shifted))
    chance = float(p @ q)
    return {
        "agreement": agree,
        "kappa": (agree - chance) / (1 - chance),
        "total_variation": float(0.5 * np.abs(p - q).sum()),
        "bar_1": float(p[0]),
        "wasserstein": float(np.abs(np.cumsum(p - q))[:-1].sum()),
    }


def rank_cell(process: Shadowing, flights: int) -> dict[str, object]:
    """Coverage of what is said of ranks."""
    rng, mix = np.random.default_rng(process.n), 0.8
    truth = rank_truth(mix)
    hits = dict.fromkeys(truth, 0)
    for _ in range(flights):
        measured, other = process.sequences(rng, 2)
        simulated = mix * measured + np.sqrt(1 - mix**2) * other
        fit = compare_ranks(
            np.searchsorted(CUTS, measured) + 1.0, np.searchsorted(CUTS + 0.3, simulated) + 1.0, replicates=300
        )
        swapped = compare_ranks(
            np.searchsorted(CUTS + 0.3, simulated) + 1.0, np.searchsorted(CUTS, measured) + 1.0, replicates=20
        )
        ends = {
            "agreement": fit.agreement_ci95, "kappa": fit.kappa_ci95, "total_variation": fit.total_variation_ci95,
            "wasserstein": fit.wasserstein_ci95, "bar_1": swapped.histogram_ci95[0],
        }  # fmt: skip
        for name, (low, high) in ends.items():
            hits[name] += low <= truth[name] <= high
    return {"flight": str(process), **{name: count / flights for name, count in hits.items()}}


def sample_verdicts(draws: int) -> float:
    """Share of draws of the sample flight's levels on which ray tracing is better by an interval without zero."""
    folder = Path(__file__).parents[1] / "sample_logs"
    data = load_data(load_flight(folder / "flight.yaml"), folder)
    plan, run = data.settings.flight.plan, run_flight(data, audit=False)
    assert plan is not None
    rng, better = np.random.default_rng(1), 0
    for _ in range(draws):
        panels = []
        for panel in run.result.rss:
            noise = correlated_noise(
                rng, len(panel.time), plan.fading_db, plan.rss_interval_s, plan.fading_correlation_s
            )
            apart = {name: panel.simulated_dbm - level.level_dbm for name, level in panel.baselines.items()}
            panels.append((panel.time, noise + 0.0 * panel.simulated_dbm, {n: noise + a for n, a in apart.items()}))
        pairs = [pooled_difference([(t, own, e[name]) for t, own, e in panels]) for name in panels[0][2]]
        better += max(pairs, key=lambda pair: -pair.other_rmse_db).verdict == "better"
    return better / draws


def judge(rows: list[dict[str, object]]) -> None:
    """Which coverages are outside what is asked, by count and beyond chance, and which intervals are too wide."""
    for name in ("offset", "rmse"):
        counted = sorted((row[f"{name}_coverage"], row["flights"], row["flight"]) for row in rows)
        outside = [row for row in counted if not ASKED[0] <= row[0] <= ASKED[1]]
        ends = [wilson(*row[:2]) for row in outside]
        sure = [row[2] for row, (low, high) in zip(outside, ends, strict=True) if high < ASKED[0] or low > ASKED[1]]
        wide = [(row["flight"], round(row[f"{name}_width_ratio"], 2)) for row in rows
                if row["memories"] > 19.99 and row[f"{name}_width_ratio"] > 1.5]  # fmt: skip
        (least, few, worst), (most, many, best) = counted[0], counted[-1]
        print(f"{name}: {100 * least:.1f} % ({few} flights of {worst}) to {100 * most:.1f} % ({many} of {best});")
        print(f"  {len(outside)} of {len(rows)} kinds outside, beyond chance {sure or 0}; wider than 1.5: {wide or 0}")


def show(rows: list[dict[str, object]]) -> None:
    """The last row of a table, below its head where it is the first."""
    if len(rows) == 1:
        print(
            " ".join(f"{name.replace('_', ' '):>18s}" for name, value in rows[0].items() if isinstance(value, float)),
            "  flight",
        )
    numbers = " ".join(f"{value:18.3f}" for value in rows[-1].values() if isinstance(value, float))
    print(f"{numbers}   {rows[-1]['flight']}", flush=True)


TABLES = {
    "level": (level_cell, GRID), "between": (level_cell, BETWEEN), "pooled": (pooled_cell, POOLED),
    "rank": (rank_cell, [Shadowing(n, (float(np.exp(-1.0 / m)),)) for n, m in ((1500, 5.0), (3000, 30.0))]),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200, help="simulated flights per cell")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", choices=(*TABLES, "sample"), help="one table alone")
    arguments = parser.parse_args()
    if arguments.only == "sample":
        print(f"sample flight: better than the best baseline in {sample_verdicts(arguments.flights):.3f} of the draws")
        return
    tables: dict[str, list[dict[str, object]]] = {}
    for name in [arguments.only] if arguments.only else TABLES:
        (cell, kinds), tables[name] = TABLES[name], []
        for kind in kinds:
            tables[name].append(cell(kind, arguments.flights))
            if not arguments.json:
                show(tables[name])
        if cell is level_cell and not arguments.json:
            judge(tables[name])
    if arguments.json:
        print(json.dumps({"flights": arguments.flights, **tables}))


if __name__ == "__main__":
    main()
