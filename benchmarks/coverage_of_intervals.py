"""Coverage of the stated 95 % intervals and share of false pooled verdicts, on simulated flights.

The errors of a flight are of one kind. Over time they are rough (AR(1)) or smooth (AR(2)), with white noise, heavy
tails (Student's t with four degrees of freedom), uneven spacing or a gap. Over place they follow a lawnmower, random
waypoints, an orbit, legs out and back, or legs with hovers. Some kinds are correlated over both. There are two kinds
of tables:

* Offset and RMSE of one channel: share of intervals that cover the mean of the process and the RMSE that such flights
  have on average, and median width relative to the interval for a known correlation. Coverage should be 92-97 %, and
  at least 92 % for errors over place. More flights are simulated while chance can explain a deviation (Wilson
  interval), up to the last of the multiples :data:`STAGES`, or the one before it if only 97 % is near. The ratio of
  widths should be at most 1.5 from 20 correlation times per flight, and at most 3 for offsets over place.
* Two models over ten channels (4 dB): false verdicts on equal models, whose errors are random, partly common to all
  channels, or common with noise of each channel, or whose predictions differ along a route. A share that is too large
  is estimated again from more and other flights. Power if the difference is 0.3 dB, and that of a test that knows the
  spread (from :data:`KNOWN` other flights). Share of flights on which a channel is called better or worse, corrected
  for the number of channels. Share of verdicts if one model is right.

The weights are fitted to the kinds of the tables "level", "place" and "pooled". "between" and "place-between" have
other kinds. In "unlike", channels have different correlations. In "loud", the error is two to five times larger for a
sixth of the flight, and the column "not stationary" is the share of flights for which the tool reports this. Ranks come
from thresholds on two processes. The processor time so far is printed after each table.

    python benchmarks/coverage_of_intervals.py [--flights 200] [--quick] [--seed 0] [--only TABLE ...] [--figure PNG]

The figure of docs/intervals.md is drawn with ``--only place place-between``.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.stats import binomtest, multivariate_normal, norm

from aerpaw_cmp.common.units import FloatArray, IntArray
from aerpaw_cmp.compare.rank import compare_ranks
from aerpaw_cmp.compare.statistics import (
    PairedDifference,
    corrected,
    loud_part,
    mean_interval,
    paired_difference,
    pooled_difference,
    spread_interval,
)

SHADOW_DB, CHANNELS, APART_DB = 4.0, 10, 0.3
CUTS = np.array([-0.8, 0.5, 1.6])
ASKED, FALSE, SEED = (0.92, 0.97), 0.06, 0
STAGES: tuple[int, ...] = (1, 3, 8)
KNOWN, POWER = 1500, 0.6


def flown(route: str, n: int) -> FloatArray:
    """Return the positions (n, 3) of a route, a sample every 10 m [m]."""
    at, flat = np.arange(n), np.zeros(n)
    if route == "lawnmower":  # legs of 400 m, 60 m apart
        leg, along = np.divmod(at, 40)
        return np.column_stack([np.where(leg % 2 == 0, along, 39 - along) * 10.0, 60.0 * leg, flat])
    if route == "orbit":  # two heights, rounds of 940 m
        turn = at * 10.0 / 150.0
        return np.column_stack([150.0 * np.cos(turn), 150.0 * np.sin(turn), 30.0 * (at > n // 2)])
    if route == "radial":  # out and back on two bearings
        half = max(n // 4, 1)
        leg, along = np.divmod(at, 2 * half)
        away = np.minimum(along, 2 * half - 1 - along) * 10.0
        return np.column_stack([away * np.cos(1.2 * leg), away * np.sin(1.2 * leg), flat])
    if route == "hover":  # 30 of 50 samples at one place
        leg, along = np.divmod(10.0 * np.cumsum(at % 50 < 20), 300.0)
        return np.column_stack([np.where(leg % 2 == 0, along, 300.0 - along), 100.0 * leg, flat])
    rng = np.random.default_rng(n)  # waypoints
    corners = rng.uniform(0.0, 25.0 * np.sqrt(n), (n, 2))
    flown_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    return np.column_stack([*(np.interp(10.0 * at, flown_m, axis) for axis in corners.T), flat])


@dataclass(frozen=True)
class Shadowing:
    """A kind of flight of ``n`` samples.

    ``roots`` are those of the autoregression. ``noise`` is the standard deviation of white noise relative to the rest.
    The share ``placed`` of the variance is correlated over ``length_m`` along a ``route``. A sixth of the flight is
    ``loud`` times as large. The channels of a pooled comparison are of this kind and those ``beside`` it, in turn.
    """

    n: int
    roots: tuple[float, ...] = ()
    noise: float = 0.0
    tails: int | None = None
    spacing: str = "even"
    route: str = ""
    length_m: float = 0.0
    placed: float = 1.0
    loud: float = 1.0
    beside: tuple["Shadowing", ...] = ()

    def __str__(self) -> str:
        kind = {0: "white", 1: "AR(1)", 2: "AR(2)"}[len(self.roots)] if self.by_time else "place"
        parts = [" ".join([f"{self.n}: {kind}", *(f"{root:.4g}" for root in self.roots)])]
        parts += [f"noise {self.noise:g}"] if self.noise else []
        parts += [f"t{self.tails}"] if self.tails else []
        parts += [self.route] if self.route else []
        parts += [f"{self.length_m:g} m"] if self.length_m else []
        parts += [f"loud {self.loud:g}"] if self.loud != 1.0 else []
        parts += [self.spacing] if self.spacing != "even" else []
        return " beside ".join([", ".join(parts), *(str(other).partition(": ")[2] for other in self.beside)])

    def of(self, channel: int) -> "Shadowing":
        """Return the kind of a channel."""
        return (self, *self.beside)[channel % (1 + len(self.beside))]

    @property
    def by_time(self) -> float:
        """Share of the variance that is correlated over time, or white."""
        return 1.0 - self.placed * (self.length_m > 0.0)

    @property
    def memories(self) -> float:
        """Number of correlation times of the flight, or of independent errors that determine the mean equally well."""
        by_time = self.n * (1.0 - max(self.roots, default=0.0))
        return by_time if self.over_place is None else float(1.0 / self.over_place.mean())

    @cached_property
    def track(self) -> FloatArray | None:
        """Positions (n, 3) for the intervals [m], None if the flight has no route."""
        return flown(self.route, self.n) if self.route else None

    @cached_property
    def over_place(self) -> FloatArray | None:
        """Correlation (n, n) over place."""
        if self.track is None or not self.length_m:
            return None
        return np.asarray(np.exp(-np.linalg.norm(self.track[:, None] - self.track, axis=2) / self.length_m))

    @cached_property
    def root(self) -> FloatArray:
        """Lower root of :attr:`over_place`."""
        return np.asarray(np.linalg.cholesky(self.over_place + 1e-9 * np.eye(self.n)))

    @cached_property
    def places(self) -> IntArray:
        """Instants (n,) at which the process is sampled."""
        if self.spacing == "uneven":
            return np.sort(np.random.default_rng(3).choice(4 * self.n, self.n, replace=False))
        gap = self.n // 2 if self.spacing == "gap" else 0
        return np.arange(self.n) + np.where(np.arange(self.n) < self.n // 3, 0, gap)

    @cached_property
    def response(self) -> FloatArray:
        """Response of the process to one impulse."""
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
        of_mean = self.by_time * covariance @ apart / self.n**2
        if self.over_place is not None:
            of_mean += self.placed * self.over_place.mean()
        return float(1.0 - of_mean + self.noise**2 * (1.0 - 1.0 / self.n))

    def sequences(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return errors (count, n) of unit variance, plus noise."""

        def drawn(*shape: int) -> FloatArray:
            if self.tails is None:
                return rng.normal(size=shape)
            return rng.standard_t(self.tails, size=shape) / np.sqrt(self.tails / (self.tails - 2.0))

        if self.over_place is not None and self.by_time == 0.0:
            return self._louder(rng, drawn(count, self.n) @ self.root.T + self.noise * drawn(count, self.n))
        long = int(self.places[-1]) + 1
        if len(self.roots) == 1:
            drive = drawn(count, long) * np.sqrt(1.0 - self.roots[0] ** 2)
            drive[:, 0] /= np.sqrt(1.0 - self.roots[0] ** 2)
            x = lfilter([1.0], [1.0, -self.roots[0]], drive, axis=1)
        else:
            settled = int(12.0 / (1.0 - max(self.roots, default=0.0)))
            scale = self.response[0]
            x = lfilter([1.0], np.poly(self.roots), scale * drawn(count, settled + long), axis=1)[:, settled:]
        x = np.sqrt(self.by_time) * x[:, self.places] + self.noise * drawn(count, self.n)
        if self.over_place is not None:
            x += np.sqrt(self.placed) * drawn(count, self.n) @ self.root.T
        return self._louder(rng, x)

    def _louder(self, rng: np.random.Generator, x: FloatArray) -> FloatArray:
        if self.loud != 1.0:
            start = rng.integers(0, self.n - self.n // 6, len(x))[:, None]
            x[(np.arange(self.n) >= start) & (np.arange(self.n) < start + self.n // 6)] *= self.loud
        return np.asarray(x)


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
    + [Shadowing(n, (r,), 2) for n, r in ((60, 0.95), (100, 0.97))]  # few terms show the slow error
    + [Shadowing(n, r) for n in (150, 700) for r in ((0.85, 0.85), (0.95, 0.95), (0.95, 0.6))]
    + [Shadowing(n, r, 0.0, 5) for n in (150, 700) for r in ((), (0.7,), (0.93,))]
    + [Shadowing(700, (r,), 0.0, None, s) for r in (0.93, 0.97) for s in ("uneven", "gap")]
)
# Lengths up to a quarter of the track's extent.
PLACE = tuple(
    [Shadowing(n, (), 0.4, route=route, length_m=length) for route in ("lawnmower", "waypoints")
     for n, lengths in ((120, (20.0, 50.0)), (400, (20.0, 50.0, 100.0, 150.0)), (1200, (50.0, 150.0)))
     for length in lengths if route == "lawnmower" or length < 6.0 * np.sqrt(n)]
    + [Shadowing(n, (r,) if r else (), 0.0, route="lawnmower") for n in (120, 400, 1200) for r in (0.0, 0.5, 0.9, 0.98)]
)  # fmt: skip
PLACE_BETWEEN = tuple(
    [Shadowing(n, (), noise, route=route, length_m=length) for n in (400, 1000) for route, lengths in
     (("orbit", (35.0, 70.0)), ("radial", (35.0, 100.0)), ("hover", (35.0, 100.0))) for length in lengths
     for noise in (0.4,)]
    + [Shadowing(n, (r,), 0.3, route=route, length_m=80.0, placed=0.5) for n, route, r in
       ((400, "lawnmower", 0.7), (400, "lawnmower", 0.95), (1000, "waypoints", 0.9))]
    + [Shadowing(400, (0.9,), 0.0, route=route) for route in ("orbit", "radial", "hover", "waypoints")]
    + [Shadowing(700, (), 1.0, route="lawnmower", length_m=70.0)]
)  # fmt: skip
LOUD = tuple(
    [Shadowing(n, (r,), loud=5.0) for n, r in ((100, 0.8), (400, 0.0), (400, 0.9), (1000, 0.9), (1000, 0.98))]
    + [Shadowing(400, (), 0.4, route=route, length_m=50.0, loud=5.0) for route in ("lawnmower", "waypoints")]
    + [Shadowing(400, (0.9,), loud=loud) for loud in (2.0, 3.0)]
)
WAYS = (0.98, 0.95, 0.9, 0.8, 0.5)
# Channels of different kinds: white noise as loud as slow errors or twice as loud, many correlation times, two lengths.
UNLIKE = (
    Shadowing(600, (0.98,), beside=(Shadowing(600),)), Shadowing(600, (0.98,), beside=(Shadowing(600, (), 1.73),)),
    Shadowing(600, (WAYS[0],), beside=(*(Shadowing(600, (r,)) for r in WAYS[1:]), Shadowing(600))),
    Shadowing(400, (), 0.4, route="lawnmower", length_m=150.0,
              beside=(Shadowing(400, (), 0.4, route="lawnmower", length_m=20.0),)),
    Shadowing(400, (), 0.4, route="orbit", length_m=70.0, beside=(Shadowing(400, (0.5,)),)),
)  # fmt: skip
POOLED_PLACE = tuple(
    [Shadowing(n, (), 0.4, route=route, length_m=length) for route in ("lawnmower", "waypoints")
     for n, length in ((400, 50.0), (400, 100.0), (400, 150.0), (1200, 50.0), (1200, 150.0))
     if route == "lawnmower" or length < 6.0 * np.sqrt(n)]
    + [Shadowing(400, (), 0.4, route=route, length_m=70.0) for route in ("orbit", "radial", "hover")]
    + [Shadowing(1000, (), 0.4, route=route, length_m=70.0) for route in ("orbit", "radial")]
    + [Shadowing(400, (0.9,), 0.3, route="lawnmower", length_m=80.0, placed=0.5)]
    + [Shadowing(1000, (r,), 0.0, route="lawnmower") for r in (0.0, 0.9, 0.95)]
)  # fmt: skip
POOLED = (
    *(Shadowing(n, (r,) if r else ()) for n in (300, 1000) for r in CORRELATIONS[:-1]),
    Shadowing(1000, (0.9,), 0.5), Shadowing(1000, (0.9,), 0.0, 4), Shadowing(1000, (0.9, 0.9)),
    Shadowing(1000, (0.9,), 0.0, None, "gap"),
)  # fmt: skip


def shadowed_pair(
    rng: np.random.Generator, shadowing: Shadowing, count: int, channels: int = CHANNELS, *,
    larger: float = 1.0, shared: float = 0.0,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return errors (count, n x channels) of two models that share half of their shadowing, the first ``larger`` times.

    Samples of one time are adjacent. ``shared`` is the part that all channels have in common.
    """
    both = [shadowing.sequences(rng, count) for _ in range(2)] if shared else [0.0, 0.0]
    columns = []
    for channel in range(channels):
        kind = shadowing.of(channel)
        own, other = (np.sqrt(shared) * common + np.sqrt(1.0 - shared) * kind.sequences(rng, count) for common in both)
        columns.append((larger * own, 0.5 * own + np.sqrt(0.75) * other))
    return _together(columns)


def routed_pair(
    rng: np.random.Generator, shadowing: Shadowing, count: int, channels: int, b: float
) -> tuple[FloatArray, FloatArray]:
    """Return errors of predictions that differ along a route. The measurement is at the share ``b`` between them."""
    columns = []
    for channel in range(channels):
        phase, route = np.linspace(0.0, 2.0 * np.pi, shadowing.n), np.random.default_rng(channel)
        apart = 0.5 * sum(
            route.normal() * np.sin(k * phase + route.uniform(0.0, 6.0)) / np.sqrt(k) for k in (1, 2, 3, 5, 8, 13, 21)
        )
        noise = shadowing.of(channel).sequences(rng, count)
        columns.append((b * apart + noise, (b - 1.0) * apart + noise))
    return _together(columns)


def noisy_pair(rng: np.random.Generator, shadowing: Shadowing, count: int) -> tuple[FloatArray, FloatArray]:
    """Return errors of two models that all channels have in common, and white noise as large in each channel."""
    common, noise = shadowed_pair(rng, shadowing, count, shared=1.0), shadowed_pair(rng, Shadowing(shadowing.n), count)
    return common[0] + noise[0], common[1] + noise[1]


def _together(columns: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    first, second = (
        np.stack([e - e.mean(axis=1, keepdims=True) for e in model], axis=2) for model in zip(*columns, strict=True)
    )
    return first.reshape(len(first), -1), second.reshape(len(second), -1)


def wilson(share: float, flights: int) -> tuple[float, float]:
    """Return the 95 % interval of a share that was counted on a number of flights."""
    return binomtest(round(share * flights), flights).proportion_ci(method="wilson")


def level_cell(shadowing: Shadowing, flights: int) -> dict[str, object]:
    """Return coverage and width of offset and RMSE."""
    rng = np.random.default_rng([SEED, shadowing.n, *str(shadowing).encode()])
    many = SHADOW_DB * shadowing.sequences(rng, 2000)
    truth = float(np.sqrt(many.var(axis=1).mean())) if shadowing.loud != 1.0 else (
        SHADOW_DB * np.sqrt(shadowing.in_flight_variance)
    )  # fmt: skip
    ends, place = np.empty((0, 2, 2)), shadowing.track
    bounds = ASKED[:1] if shadowing.length_m else ASKED
    for stage in STAGES:
        errors = SHADOW_DB * shadowing.sequences(rng, stage * flights - len(ends))
        ends = np.concatenate([ends, [[mean_interval(e, place), spread_interval(e, place)] for e in errors]])
        held = ((ends[..., 0] <= (0.0, truth)) & ((0.0, truth) <= ends[..., 1])).mean(axis=0)
        if not any(a < bound < b for a, b in (wilson(share, len(ends)) for share in held) for bound in bounds):
            break
        bounds = ASKED[:1]  # the last stage only decides whether a coverage is too small
    alone = [[mean_interval(e), spread_interval(e)] for e in many[:flights]] if shadowing.length_m else ends
    alone = ((np.array(alone)[..., 0] <= (0.0, truth)) & ((0.0, truth) <= np.array(alone)[..., 1])).mean(axis=0)
    low, high = np.quantile(many.std(axis=1) / truth, [0.025, 0.975])
    known = 3.92 * many.mean(axis=1).std(), truth * (1.0 / low - 1.0 / high)
    width = np.median(np.where(np.isfinite(ends), ends, np.inf)[..., 1] - ends[..., 0], axis=0)
    return {
        "flight": str(shadowing), "flights": len(ends), "memories": shadowing.memories,
        "over_place": shadowing.length_m > 0.0,
        "not_stationary": float(np.mean([loud_part(e)[0] > 0.0 for e in many[:flights]])),
        **{f"{name}_{what}": float(value) for name, i in (("offset", 0), ("rmse", 1))
           for what, value in (("coverage", held[i]), ("by_time_alone", alone[i]),
                               ("width_ratio", width[i] / known[i]))},
    }  # fmt: skip


def pooled_cell(shadowing: Shadowing, flights: int) -> dict[str, object]:
    """Return false verdicts and power of the comparison of two models over ten channels."""
    rng = np.random.default_rng([SEED, shadowing.n, *str(shadowing).encode()])
    time = np.arange(shadowing.n)
    places = None if shadowing.track is None else [shadowing.track] * CHANNELS

    def pooled(pair: tuple[FloatArray, FloatArray]) -> list[PairedDifference]:
        channels = (e.reshape(len(pair[0]), shadowing.n, CHANNELS) for e in pair)
        return [
            pooled_difference(
                [(time, SHADOW_DB * a, SHADOW_DB * b) for a, b in zip(first.T, second.T, strict=True)], place_m=places
            )
            for first, second in zip(*channels, strict=True)
        ]

    def decided(pairs: list[PairedDifference]) -> float:
        return float(np.mean([pair.verdict in ("better", "worse") for pair in pairs]))

    def false(drawn: Callable[[int], tuple[FloatArray, FloatArray]]) -> tuple[float, bool]:
        share, count = decided(pooled(drawn(flights))), flights
        if wilson(share, flights)[0] > FALSE:  # on other flights, because one of many shares is large by chance
            count *= STAGES[len(STAGES) // 2]
            share = decided(pooled(drawn(count)))
        return share, wilson(share, count)[0] > FALSE

    equal, others = shadowed_pair(rng, shadowing, flights), np.random.default_rng([SEED + 1, shadowing.n])
    # the spread comes from other flights, without intervals
    apart = [(a * a - b * b).mean(axis=1) for a, b in (shadowed_pair(others, shadowing, KNOWN // 5) for _ in range(5))]
    known = 1.96 * SHADOW_DB**2 * np.std(apart)
    size = np.sqrt(1.0 + shadowing.noise**2)
    better = pooled(shadowed_pair(rng, shadowing, flights, larger=1.0 + APART_DB / SHADOW_DB / size))
    right = pooled(routed_pair(rng, shadowing, flights, CHANNELS, 0.0))
    by_channel = [
        corrected([paired_difference(a, b, place_m=shadowing.track) for a, b in zip(first.T, second.T, strict=True)])
        for first, second in zip(*(e.reshape(flights, shadowing.n, CHANNELS) for e in equal), strict=True)
    ]
    found = np.array([abs(pair.mean_square_difference_db2) > known for pair in better])
    short = np.array([pair.verdict in ("better", "worse") for pair in better]) - POWER * found
    shares = {
        "false": false(partial(shadowed_pair, rng, shadowing)),
        "false_shared": false(partial(shadowed_pair, rng, shadowing, shared=0.5)),
        "false_route": false(partial(routed_pair, rng, shadowing, channels=CHANNELS, b=0.5)),
        "false_noise": false(partial(noisy_pair, rng, shadowing)),
    }
    return {
        "flight": str(shadowing),
        "above": [name for name, (_, above) in shares.items() if above],
        "weak": bool(short.mean() + 1.96 * short.std() / np.sqrt(flights) < 0.0),
        **{name: share for name, (share, _) in shares.items()},
        "power": decided(better),
        "power_known": float(found.mean()),
        "right_decided": decided(right),
        "any_channel": float(np.mean([any(pair.verdict in ("better", "worse") for pair in row) for row in by_channel])),
    }


def rank_truth(mix: float) -> dict[str, float]:
    """Return agreement, kappa, distances and first bar of two thresholded unit normals with correlation ``mix``."""
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
    """Return the coverage of the intervals of a comparison of ranks."""
    rng, mix, size = np.random.default_rng([SEED, process.n]), 0.8, np.sqrt(1.0 + process.noise**2)
    truth = rank_truth(mix)
    hits = dict.fromkeys(truth, 0)
    for _ in range(flights):
        measured, other = process.sequences(rng, 2) / size
        simulated = mix * measured + np.sqrt(1 - mix**2) * other
        sides = np.searchsorted(CUTS, measured) + 1.0, np.searchsorted(CUTS + 0.3, simulated) + 1.0
        fit, swapped = (compare_ranks(*pair, process.track) for pair in (sides, sides[::-1]))
        ends = {
            "agreement": fit.agreement_ci95, "kappa": fit.kappa_ci95, "total_variation": fit.total_variation_ci95,
            "wasserstein": fit.wasserstein_ci95, "bar_1": swapped.histogram_ci95[0],
        }  # fmt: skip
        for name, (low, high) in ends.items():
            hits[name] += low <= truth[name] <= high
    return {"flight": str(process), **{name: count / flights for name, count in hits.items()}}


def judge(rows: list[dict[str, object]]) -> None:
    """Print the kinds with a coverage outside the goal, by count and beyond chance, and those with wide intervals."""
    for name in ("offset", "rmse"):
        # above 97 % only the width judges errors over place
        above = [1.0 if row["over_place"] else ASKED[1] for row in rows]
        counted = [(row[f"{name}_coverage"], row["flights"], row["flight"], top)
                   for row, top in zip(rows, above, strict=True)]  # fmt: skip
        outside = [row for row in counted if not ASKED[0] <= row[0] <= row[3]]
        ends = [wilson(*row[:2]) for row in outside]
        sure = [row[2] for row, (low, high) in zip(outside, ends, strict=True) if high < ASKED[0] or low > row[3]]
        most = [3.0 if row["over_place"] and name == "offset" else 1.5 for row in rows]
        wide = [(row["flight"], round(row[f"{name}_width_ratio"], 2)) for row, limit in zip(rows, most, strict=True)
                if (row["over_place"] or row["memories"] > 19.99) and row[f"{name}_width_ratio"] > limit]  # fmt: skip
        least, few, worst, _ = min(counted)
        print(f"{name}: {100 * least:.1f} % ({few} flights of {worst}) to {100 * max(counted)[0]:.1f} %;")
        print(f"  {len(outside)} of {len(rows)} kinds outside, beyond chance {sure or 0}; too wide: {wide or 0}")
    shares = [100.0 * row["not_stationary"] for row in rows]
    print(f"reported as not stationary: {min(shares):.1f} to {max(shares):.1f} %, mean {np.mean(shares):.1f} %")


def judge_verdicts(rows: list[dict[str, Any]]) -> None:
    """Print the kinds with too many false verdicts beyond chance, and those with less than 60 % of the power."""
    for name in ("false", "false_shared", "false_route", "false_noise"):
        sure = [row["flight"] for row in rows if name in row["above"]]
        print(f"{name}: at most {100 * max(row[name] for row in rows):.1f} %; above 6 % beyond chance: {sure or 0}")
    low = [row for row in rows if row["power"] < POWER * row["power_known"]]
    weak = [(row["flight"], round(row["power"] / row["power_known"], 2)) for row in low if row["weak"]]
    print(f"power below 60 % of that of a test that knows the spread: {len(low)}; beyond chance: {weak or 0}")


def draw(rows: list[dict[str, object]], file: Path) -> None:
    """Draw the coverage of the kinds over place, with intervals over time alone and over time and place."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    rows = [row for row in rows if row["over_place"]]
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 0.24 * len(rows) + 1.4), sharey=True, layout="constrained")
    for axis, name in zip(axes, ("offset", "rmse"), strict=True):
        axis.axvspan(100 * ASKED[0], 100, color="0.92")
        for what, colour, label in (("by_time_alone", "tab:orange", "correlation over time alone"),
                                    ("coverage", "tab:blue", "over time and place")):  # fmt: skip
            axis.plot([100 * row[f"{name}_{what}"] for row in rows], range(len(rows)), "o", color=colour, label=label)
        axis.set(title={"offset": "Offset", "rmse": "RMSE"}[name], xlabel="flights covered (%)", xlim=(35, 101))
        axis.grid(axis="x", alpha=0.4)
    names = [str(row["flight"]).replace("place, noise 0.4, ", "").replace(", noise 0.3", " and place") for row in rows]
    axes[0].set_yticks(range(len(rows)), names)
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    figure.savefig(file, dpi=90)


def show(rows: list[dict[str, object]]) -> None:
    """Print the last row of a table, and the names of its columns before the first row."""
    if len(rows) == 1:
        print(
            " ".join(f"{name.replace('_', ' '):>18s}" for name, value in rows[0].items() if isinstance(value, float)),
            "  flight",
        )
    numbers = " ".join(f"{value:18.3f}" for value in rows[-1].values() if isinstance(value, float))
    print(f"{numbers}   {rows[-1]['flight']}", flush=True)


TABLES = {
    "level": (level_cell, GRID), "between": (level_cell, BETWEEN), "place": (level_cell, PLACE),
    "place-between": (level_cell, PLACE_BETWEEN), "loud": (level_cell, LOUD), "pooled": (pooled_cell, POOLED),
    "pooled-place": (pooled_cell, POOLED_PLACE), "unlike": (pooled_cell, UNLIKE),
    "rank": (rank_cell, [*(Shadowing(n, (float(np.exp(-1.0 / m)),)) for n, m in ((1500, 5.0), (3000, 30.0))),
                         *(Shadowing(n, (), 0.4, route=route, length_m=50.0)
                           for n, route in ((1000, "lawnmower"), (400, "waypoints")))]),
}  # fmt: skip
# With ``--quick``: every third kind, and this number of flights.
EVERY, QUICK = 3, 60


def main() -> None:
    global STAGES, SEED, KNOWN
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=200, help="simulated flights per cell")
    parser.add_argument("--quick", action="store_true", help="some kinds, few flights: about 2 minutes")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--figure", type=Path, help="draw the coverage of the kinds over place")
    parser.add_argument("--only", nargs="+", choices=tuple(TABLES), help="these tables alone")
    arguments = parser.parse_args()
    flights, every, SEED = arguments.flights, 1, arguments.seed
    if arguments.quick:
        flights, every, STAGES, KNOWN = QUICK, EVERY, (1,), 5 * QUICK
    tables: dict[str, list[dict[str, object]]] = {}
    for name in arguments.only or TABLES:
        (cell, kinds), tables[name] = TABLES[name], []
        for kind in kinds[::every]:
            tables[name].append(cell(kind, flights))
            if not arguments.json:
                show(tables[name])
        if cell is level_cell and not arguments.json:
            judge(tables[name])
        if cell is pooled_cell and not arguments.json:
            judge_verdicts(tables[name])
        if not arguments.json:
            print(f"{process_time():.0f} s of processor time so far\n")
    if arguments.figure:
        draw([row for name in tables if name.startswith("place") for row in tables[name]], arguments.figure)
    if arguments.json:
        print(json.dumps({"flights": flights, **tables}))


if __name__ == "__main__":
    main()
