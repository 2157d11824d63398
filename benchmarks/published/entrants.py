"""Our own entrants: baselines, standards, Kriging, ray tracing, trees, by the public face of the package alone."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
import pandas as pd

import aerpaw_cmp as ac

# Names of the columns that tell a place.
PLACE = ["east_m", "north_m", "up_m"]
TOWER = [f"tower_{name}" for name in PLACE]

# A flight by its name.
Flights = Callable[[str], ac.Flight]

# Gain of a model (n,) at rows, up to a constant for each channel [dB].
Gain = Callable[[pd.DataFrame], Any]

# Level and standard deviation (n,) of the asked rows [dB].
Answer = tuple[Any, Any]


def _distance_m(rows: pd.DataFrame) -> Any:
    return np.linalg.norm(rows[PLACE].to_numpy() - rows[TOWER].to_numpy(), axis=1)


def _offsets(values: Any, known: pd.DataFrame, asked: pd.DataFrame) -> Any:
    """Return means (n,) for target rows: of known rows of the same series, else the same channel, else all."""
    table, out = known.assign(value=values), np.full(len(asked), np.mean(values))
    for keys in (["tower", "channel"], ["flight", "tower", "channel"]):
        means = asked[keys].merge(table.groupby(keys, as_index=False)["value"].mean(), how="left", on=keys)["value"]
        out = np.where(means.notna(), means, out)
    return out


def anchored(gain: Gain, known: pd.DataFrame, asked: pd.DataFrame) -> Answer:
    """Add the offsets of the known rows to a gain.

    The standard deviation is that of the known rows about their offsets.
    """
    error = known["measured"].to_numpy() - gain(known)
    spread = np.std(error - _offsets(error, known, known))
    return gain(asked) + _offsets(error, known, asked), np.full(len(asked), max(float(spread), 0.1))


def _free_space(rows: pd.DataFrame) -> Any:
    return -20.0 * np.log10(_distance_m(rows))


def _log_distance(known: pd.DataFrame, asked: pd.DataFrame, _: Flights) -> Answer:
    """Fit a slope over the logarithm of the distance for each channel, with a free offset per series."""
    x, y = np.log10(_distance_m(known)), known["measured"].to_numpy()
    slopes = {}
    for channel in {*known["channel"], *asked["channel"]}:
        rows = (known["channel"] == channel).to_numpy()
        rows = rows if rows.any() else np.ones(len(known), dtype=bool)
        series = known[rows].groupby(["flight", "tower", "channel"], sort=False).ngroup().to_numpy()
        dx, dy = (v[rows] - pd.Series(v[rows]).groupby(series).transform("mean").to_numpy() for v in (x, y))
        slopes[channel] = float(dx @ dy / (dx @ dx))
    return anchored(lambda rows: rows["channel"].map(slopes).to_numpy() * np.log10(_distance_m(rows)), known, asked)


def tr36777_loss_db(scenario: str, distance_m: Any, height_m: Any, carrier_hz: Any) -> Any:
    """Median path loss (n,) to an aerial terminal in sight [dB], by 3GPP TR 36.777 V15.0.0 table B-2.

    ``scenario`` is RMa-AV or UMa-AV; heights above ground [m] below 10 m count as 10 m, where the formula begins.
    """
    ghz = carrier_hz / 1e9
    if scenario == "UMa-AV":
        return 28.0 + 22.0 * np.log10(distance_m) + 20.0 * np.log10(ghz)
    slope = np.maximum(23.9 - 1.8 * np.log10(np.maximum(height_m, 10.0)), 20.0)
    return slope * np.log10(distance_m) + 20.0 * np.log10(40.0 * np.pi * ghz / 3.0)


def p1411_loss_db(distance_m: Any, carrier_hz: Any) -> Any:
    """Median loss (n,) from a station above the roofs in sight [dB], by ITU-R P.1411-12 section 4.2.1."""
    return 22.9 * np.log10(distance_m) + 28.6 + 19.6 * np.log10(carrier_hz / 1e9)


def _of_place(gain: Gain) -> Callable[[pd.DataFrame, pd.DataFrame, Flights], Answer]:
    return lambda known, asked, _: anchored(gain, known, asked)


def _places(rows: pd.DataFrame, *keys: str) -> Any:
    """Values of the columns with the numbers of their rows."""
    return rows.groupby(list(keys)).indices.items()


@cache
def _replayed(flight: ac.Flight, engine: str, depth: int, level: str) -> dict[tuple[str, str], Any]:
    """Level (n,) of every sample by ray tracing, by tower and channel."""
    series = flight.replay(engine, max_depth=depth).series
    return {key: item.spread(getattr(item.replay, level)[:, 0]) for key, item in series.items()}


def _replay(engine: str, depth: int, level: str, known: pd.DataFrame, asked: pd.DataFrame, flights: Flights) -> Answer:
    """Predict by ray tracing. If there is no path, use the mean of the other predictions."""

    def gain(rows: pd.DataFrame) -> Any:
        out = np.full(len(rows), np.nan)
        for (flight, *key), places in _places(rows, "flight", "tower", "channel"):
            levels = _replayed(flights(flight), engine, depth, level)[tuple(key)]
            out[places] = levels[rows["sample"].to_numpy()[places]]
        return np.where(np.isfinite(out), out, np.nanmean(out))

    return anchored(gain, known, asked)


def _kriging(known: pd.DataFrame, asked: pd.DataFrame, _: Flights) -> Answer:
    """The level about its log-distance line over place, from the nearest of what is known."""
    line, spread = _log_distance(known, asked, _)
    left = known["measured"].to_numpy() - _log_distance(known, known, _)[0]
    every = slice(None, None, max(1, len(known) // 2000))
    variogram = ac.Variogram().fit(known[PLACE[:2]].to_numpy()[every], left[every])
    fitted = ac.OrdinaryKriging(variogram.model_).fit(known[PLACE].to_numpy()[every], left[every])
    mean, variance = fitted.predict(asked[PLACE].to_numpy())
    far = ~np.isfinite(mean)
    return line + np.where(far, 0.0, mean), np.where(far, spread, np.sqrt(np.maximum(variance, 0.25)))


def _trees(known: pd.DataFrame, asked: pd.DataFrame, _: Flights) -> Answer:
    """Gradient-boosted trees on the geometry: the strong black box."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    names = sorted(set(known["channel"]))

    def features(rows: pd.DataFrame) -> Any:
        ray = (rows[PLACE].to_numpy() - rows[TOWER].to_numpy()) / _distance_m(rows)[:, None]
        turn = np.radians(rows["heading_deg"].to_numpy(np.float64))
        code = rows["channel"].map({name: i for i, name in enumerate(names)}).fillna(-1.0)
        return np.column_stack([_free_space(rows), rows[PLACE], ray, np.sin(turn), np.cos(turn), code])

    x = features(known)
    y = known["measured"].to_numpy() - _free_space(known)
    y = y - _offsets(y, known, known)
    half = known["time"] > known.groupby("flight")["time"].transform(lambda t: sorted(t)[len(t) // 2])

    def fitted(rows: Any) -> Any:
        model = HistGradientBoostingRegressor(max_iter=100, learning_rate=0.1, max_depth=5, random_state=0)
        return model.fit(x[rows], y[rows])

    # the spread is that of one half of each flight predicted from the other: trees reproduce their own training samples
    error = np.where(half, fitted(~half).predict(x), fitted(half).predict(x)) - y
    model = fitted(np.ones(len(y), dtype=bool))
    level, _ = anchored(lambda rows: _free_space(rows) + model.predict(features(rows)), known, asked)
    return level, np.full(len(level), error.std())


LEVEL: dict[str, Callable[[pd.DataFrame, pd.DataFrame, Flights], Answer]] = {
    "free_space": _of_place(_free_space),
    "constant": _of_place(lambda rows: np.zeros(len(rows))),
    "log_distance": _log_distance,
    "tr36777_rma_av": _of_place(
        lambda rows: (
            -tr36777_loss_db("RMa-AV", _distance_m(rows), rows["up_m"].to_numpy(), rows["carrier_hz"].to_numpy())
        )
    ),
    "tr36777_uma_av": _of_place(
        lambda rows: -tr36777_loss_db("UMa-AV", _distance_m(rows), None, rows["carrier_hz"].to_numpy())
    ),
    "p1411": _of_place(lambda rows: -p1411_loss_db(_distance_m(rows), rows["carrier_hz"].to_numpy())),
    "kriging": _kriging,
    "replay_paper": partial(_replay, "image", 2, "rss_dbm"),
    "replay_drafted": partial(_replay, "image", 1, "rss_power_dbm"),
    "replay_sionna": partial(_replay, "sionna", 1, "rss_power_dbm"),
    "boosted_trees": _trees,
}

# Minutes per flight, and the paths of ``replay_drafted``.
ONLY_ON_DEMAND = ("replay_sionna",)


def _shares(rank: Any) -> Any:
    """Share (4,) of each rank, a report of each added so that none is impossible."""
    return (np.bincount(rank.astype(int), minlength=5)[1:5] + 1.0) / (len(rank) + 4.0)


def _rank_constant(known: pd.DataFrame, asked: pd.DataFrame, _: Flights) -> Any:
    return np.tile(_shares(known["measured"].to_numpy()), (len(asked), 1))


@cache
def _ranks(flight: ac.Flight, tower: str, k: float) -> Any:
    replayed = flight.replay().series[tower, "rank"]
    return replayed.spread(ac.channel_rank(replayed.replay.h[:, 0], k).astype(float), 0.0)


def _rank_replay(known: pd.DataFrame, asked: pd.DataFrame, flights: Flights) -> Any:
    """Shares of what was reported at each simulated rank, for the K of the least log score on what is known."""

    def simulated(rows: pd.DataFrame, k: float) -> Any:
        out = np.zeros(len(rows), dtype=int)
        for (flight, tower), places in _places(rows, "flight", "tower"):
            out[places] = _ranks(flights(flight), tower, k)[rows["sample"].to_numpy()[places]]
        return out

    measured = known["measured"].to_numpy().astype(int)
    scored = []
    for k in (10.0, 100.0, 1000.0):
        mine = simulated(known, k)
        table = np.array([_shares(measured[mine == rank]) for rank in range(5)])
        scored.append((-np.log(table[mine, measured - 1]).mean(), k, table))
    _, k, table = min(scored, key=lambda row: row[0])
    return table[simulated(asked, k)]


RANK: dict[str, Callable[[pd.DataFrame, pd.DataFrame, Flights], Any]] = {
    "constant": _rank_constant,
    "replay": _rank_replay,
}
