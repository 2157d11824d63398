"""The page prediction.html with metrics.json, prediction.csv and prediction.nc, and their sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup
from numpy.typing import ArrayLike

from ..common.cf import DB, Dataset, file_attributes, netcdf_bytes
from ..common.errors import UsageError
from ..common.grouping import lists_by_key
from ..common.jsonable import json_object
from ..common.text import guarded
from ..common.units import FloatArray
from ..compare.calibration import OFF, Correction, crps_difference
from ..compare.statistics import paired_difference
from ..compare.verdict import Verdict, by_flight, stated_errors
from ..site.learned import Entry, LearnedSeries
from ..site.site import Site
from .cards import HEAD, SHARE, TEXT, Card, Page, Positions, Table, bold, paragraph, write_page
from .flight_data import RANKS
from .flight_words import filled, sentence_of
from .page import Made, about, write_file
from .places import BAND, LIKELIEST, Places, payload
from .texts import minute, number

TITLES = {
    "learned": "antennas learned from the named flights",
    "replay": "ray tracing with the flights' own settings",
    "free space": "free space",
    "none": "a constant level",
    "memory": "learned antennas of the site",
    "prior": "ray tracing with isotropic antennas, before any flight",
}

# Flags of points. Outside the flown area, no samples nearby reduce the standard deviation.
FLAGS = ("outside_flown", "out_of_coverage", "no_position")

# If a larger share of the points is outside the flown area, the summary states this share.
MANY = 0.2

# Sentences about the selected model on held-out data, by the verdict of the paired interval.
AGAINST_FREE_SPACE = {
    "better": ("On held-out {over} it is {size:.1f} dB better than free space [{near:.1f}, {far:.1f}] (95 %).", ""),
    "worse": ("On held-out {over} it is {size:.1f} dB worse than free space [{near:.1f}, {far:.1f}] (95 %).", ""),
    "not significant": (
        "On held-out {over} the difference from free space [{low:+.1f}, {high:+.1f}] is not significant (95 %).", ""
    ),
    "no interval": ("The flight is too short for an interval of the difference from free space.", ""),
    "two flights": (
        "On held-out {over} the RMSE differs from that of free space by {effect:+.1f} dB; an interval requires three "
        "flights.", ""
    ),
}  # fmt: skip

# Sentences about the residual field, by the interval of the difference in CRPS; ``off`` if it includes zero.
_FIELD = "The residual field (a spatial correction) is "
FIELD = {
    "better": (_FIELD + "on: it lowers the CRPS by {size:.2f} dB on held-out samples.", ""),
    "worse": (_FIELD + "off: it raises the CRPS by {size:.2f} dB on held-out samples.", ""),
    "off": (_FIELD + "off: the CRPS differs by {size:.2f} dB, not significantly.", ""),
}

# Sentences about the stated standard deviations on held-out data, by :func:`~aerpaw_cmp.compare.verdict.stated_errors`.
_INSIDE = "90 % intervals contain {inside:.0f} % of the held-out samples."
_ERRORS = "errors are {effect:.1f} times as large as stated (95 %: {low:.1f} to {high:.1f})."
_BIAS = "the measured level is {effect:+.1f} dB (95 %: {low:+.1f} to {high:+.1f} dB) above the predicted one."
STATED = {
    "none": (_INSIDE, ""),
    "narrow": (f"{_INSIDE} They are too narrow: {_ERRORS}", "add a flight of this area"),
    "wide": (f"{_INSIDE} They are too wide: {_ERRORS}", ""),
    "biased": (f"{_INSIDE} T{_BIAS[1:]}", "check the gain of the training flights"),
}

EXPECTED = (
    "Expect an RMSE of {error:.1f} dB{over} at these points on a new flight ({heading}); 90 % of the samples "
    "lie within \u00b1{band:.1f} dB."
)
NOWHERE = "No level is predicted: no path reaches any of the points."
LOCK = "The receiver is in lock for {percent:.0f} % of them (P(lock) of each point: `p_lock` in prediction.csv)."
REMEMBERED = "No flight is named: antennas and levels are those learned at this site."
PRIOR = (
    "No flight is known: ray tracing with isotropic antennas, {carrier:g} GHz, {power:g} dBm transmitted. Next: fly "
    "once, then `aerpaw-cmp predict --with flight.yaml`."
)
OUTSIDE = {
    "flown": "{percent:.0f} % of the points are outside the flown area.",
    "site": "{percent:.0f} % of the points are outside the area of the site (`area_m`), where the map may end.",
    "remembered": "{percent:.0f} % of the points are in directions that few training samples have.",
}
PLAN = "Next: `aerpaw-cmp plan` finds the flight that reduces the standard deviation most."


def heading_words(yaw_deg: FloatArray) -> str:
    """Return the heading for which a prediction is valid, as text.

    Examples
    --------
    >>> heading_words(np.array([90.0, 90.0])), heading_words(np.array([0.0, 90.0])), heading_words(np.array([np.nan]))
    ('heading 90 degrees', 'headings of the route', 'any heading')
    """
    if not np.isfinite(yaw_deg).all():
        return "any heading"
    return "headings of the route" if np.ptp(yaw_deg) else f"heading {yaw_deg[0]:.0f} degrees"


def first_sentences(
    correction: Correction | None,
    outside: float,
    expected_db: float,
    band_db: float,
    heading: str = "any heading",
    lock: float | None = None,
    origin: str = REMEMBERED,
) -> str:
    """Return the summary for terminal, page and metrics.json: error with band, best baseline, and next step.

    Parameters
    ----------
    correction : Correction, optional
        None if the prediction uses the learned models of the site.
    outside : float
        Share of points outside the flown area, or in directions with few training samples.
    expected_db : float
        Stated standard deviation of a 4-s mean on a new flight, as root mean square over the points [dB]. For a
        receiver that loses its lock, it is the standard deviation of a sample.
    band_db : float
        Half the width of the 90 % interval of a sample, averaged over the points [dB].
    heading : str
        Text of :func:`heading_words`.
    lock : float, optional
        Mean probability of lock, for a receiver that can lose its lock.
    origin : str
        Sentence about the source of the prediction, if there is no correction.

    Returns
    -------
    str
    """
    over = " over 4 s means" if lock is None else ""
    known = [EXPECTED] if np.isfinite(expected_db) else [NOWHERE]
    texts = filled(known, error=expected_db, band=band_db, heading=heading, over=over)
    texts += [] if lock is None else filled([LOCK], percent=100.0 * lock)
    step = ""
    if correction is None:
        texts.append(origin)
    else:
        if ("free space", OFF) in correction.rmse_db and (correction.base, correction.title) != ("free space", OFF):
            verdict = _against_free_space(correction)
            near, far = sorted(map(abs, verdict.interval))
            over = "flights" if len(correction.flights) > 1 else "blocks of the flight"
            texts.append(sentence_of(verdict, AGAINST_FREE_SPACE, over=over, near=near, far=far))
        step = _stated(correction)[0].partition("Next: ")[2]
    texts.append(PLAN if outside > MANY else f"Next: {step}" if step else "")
    return " ".join(text for text in texts if text)


def cautions(correction: Correction, outside: float) -> list[str]:
    """Return warnings about the flown area, and about standard deviations that held-out data contradict."""
    texts = filled([OUTSIDE["flown"]], percent=100.0 * outside) if outside > MANY else []
    stated, holds = _stated(correction)
    return texts if holds else [*texts, stated.partition(" Next: ")[0]]


def notes(correction: Correction) -> list[str]:
    """Return sentences about the model, about the residual field, and about intervals if held-out data confirm them."""
    stated, holds = _stated(correction)
    texts = [stated if holds else "", f"Model: {TITLES[correction.base]}.", sentence_of(field(correction), FIELD)]
    return [text for text in texts if text]


def stored_model_notes(known: Sequence[tuple[Entry, LearnedSeries]]) -> list[str]:
    """Return sentences about the learned models of the site that a prediction without flights uses."""
    each = lists_by_key((entry.about(), f"{series.tower} {series.channel}") for entry, series in known)
    return [f"{', '.join(names)}: {about}." for about, names in each.items()]


def prior_cautions(sd_db: Mapping[str, float], beyond: float) -> list[str]:
    """Return warnings for a prediction before any flight.

    ``sd_db`` contains the parts of the standard deviation [dB]. ``beyond`` is the share of points outside the site.
    """
    parts = ", ".join(f"{name} {value:g} dB" for name, value in sd_db.items())
    texts = filled([OUTSIDE["site"]], percent=100.0 * beyond) if beyond else []
    texts.append(f"The standard deviation is a prior: {parts}. One flight determines most of these parts.")
    return texts


def _stated(correction: Correction) -> tuple[str, bool]:
    """Return sentence and next step about the stated standard deviations, and whether held-out data confirm them."""
    error, sd = correction.held_out[correction.base, correction.title]
    verdict = stated_errors(error, sd, place_m=correction.held_out_place_m)
    known = np.isfinite(error)
    inside = np.abs(error[known]) <= 1.6449 * sd[known]  # 1.6449 SD is half of a 90 % interval
    share = 100.0 * float(inside.mean()) if known.any() else float("nan")
    return sentence_of(verdict, STATED, inside=share), verdict.cause == "none"


def _against_free_space(correction: Correction) -> Verdict:
    """Compare the chosen model with free space on held-out data, per flight or per block of a single flight."""
    error, free_space = (
        correction.held_out[key][0] for key in ((correction.base, correction.title), ("free space", OFF))
    )
    if len(correction.flights) > 1:
        # compare per flight as in calibrate, because samples of one flight share offset and weather
        parts = correction.held_out_parts
        verdict = by_flight(_by_part(error, parts), _by_part(free_space, parts))
        return replace(verdict, cause="two flights") if verdict.cause == "no interval" else verdict
    pair = paired_difference(error, free_space, free_offset=False, place_m=correction.held_out_place_m)
    return Verdict(cause=pair.verdict, effect=pair.difference_db, interval=pair.difference_ci95_db)


def _by_part(error: FloatArray, parts: Sequence[tuple[str, int]]) -> Iterator[tuple[str, float]]:
    """Yield flight and RMSE [dB] of each part of held-out errors (n,)."""
    ends = np.cumsum([size for _, size in parts])
    for (flight, _), part in zip(parts, np.split(error, ends[:-1]), strict=True):
        known = part[np.isfinite(part)]
        yield flight, float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def field(correction: Correction) -> Verdict:
    """Return the verdict on the difference in CRPS between the best residual field and no residual field."""
    base = correction.base
    title = min((t for b, t in correction.crps_db if b == base and t != OFF), key=lambda t: correction.crps_db[base, t])
    difference, ends = crps_difference(correction.held_out, (base, title), correction.held_out_place_m)
    cause = "better" if correction.on else "worse" if ends[0] > 0.0 else "off"
    return Verdict(cause=cause, effect=difference, interval=ends, where=title)


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictionPage(Made):
    """The content of the page of ``predict``. ``table`` has the columns of prediction.csv."""

    name: str
    kind: str
    site: Site
    table: pd.DataFrame
    units: Mapping[str, str]
    shape: tuple[int, int] | None
    heights_m: tuple[float, ...]
    verdict: str
    candidates: Sequence[Mapping[str, Any]]
    model: Mapping[str, float]
    chosen: Mapping[str, Any]
    flown: Mapping[str, Any]
    flights: Sequence[str]
    trained_on: Sequence[str]
    marks: Sequence[str]
    warnings: Sequence[str]
    notes: Sequence[str] = ()

    @property
    def levels(self) -> pd.DataFrame:
        """The rows with a level, of all towers and channels."""
        levels: pd.DataFrame = self.table[self.table["channel"] != "rank"]
        return levels

    @property
    def series(self) -> list[tuple[str, pd.DataFrame]]:
        """The name and rows of each tower and channel with levels."""
        each = self.levels.groupby(["tower", "channel"], sort=False, observed=True)
        return [(f"{t} {c}", part) for (t, c), part in each]


def outside_share(table: pd.DataFrame) -> float:
    """Return the share of levels with a position that are outside the flown area."""
    flag = table["flag"][(table["channel"] != "rank") & (table["flag"] != "no_position")]
    return float((flag == "outside_flown").mean())


def prediction_metrics(data: PredictionPage) -> dict[str, Any]:
    """Return the numbers of metrics.json."""
    series = {
        name: {
            "unit": data.units.get(name, ""),
            "points": len(part),
            "mean_level_db": part["level_db"].mean(),
            "mean_sd_db": part["sd_db"].mean(),
            "mean_p_lock": part["p_lock"].mean() if "p_lock" in part else None,
            "share_outside_flown": outside_share(part),
            **{f"share_{flag}": float((part["flag"] == flag).mean()) for flag in FLAGS if flag != "outside_flown"},
        }
        for name, part in data.series
    }
    ranks = data.table[data.table["channel"] == "rank"]
    return json_object(
        prediction=data.name,
        kind=data.kind, flights=data.flights, trained_on=data.trained_on, marks=data.marks, chosen=data.chosen,
        candidates=data.candidates, warnings=data.warnings, notes=data.notes,
        sentence=data.verdict,
        field=data.model,
        series=series,
        ranks={
            tower: {k: part[f"p_rank{k}"].mean() for k in "1234"}
            for tower, part in ranks.groupby("tower", observed=True)
        },
        **about(data),
    )  # fmt: skip


def prediction_page(data: PredictionPage, numbers: Mapping[str, Any], shown: Mapping[str, Any]) -> Page:
    """Return the page from its numbers. ``shown`` is the data of its map."""
    about = f"Learned from {', '.join(data.flights)}. " if data.flights else ""
    about += f"Made {minute(data.generated)}. prediction.csv in the same folder contains every point."
    return Page(
        kind="prediction", title=data.name, verdict=data.verdict, cautions=data.warnings, about=[*data.notes, about],
        cards=[Card(title="Map", positions=Positions(view="places", data=shown)),
               _levels_card(numbers, lock="p_lock" in data.table, flown=bool(data.flights)),
               _model_card(data)],
    )  # fmt: skip


def _levels_card(numbers: Mapping[str, Any], *, lock: bool, flown: bool) -> Card:
    columns: dict[str, tuple[str, str | int]] = {
        "unit": ("Unit", TEXT), "points": ("Points", 0), "mean_level_db": ("Level", 1), "mean_sd_db": ("SD [dB]", 1),
        **({"mean_p_lock": ("P(lock)", 2)} if lock else {}),
        **({"share_outside_flown": ("Outside flown area", SHARE)} if flown else {}),
    }  # fmt: skip
    levels = Table(
        caption="Means over all points. SD is the standard deviation of one sample.",
        columns={"Tower, channel": HEAD, **dict(columns.values())},
        rows=[(name, *(series[key] for key in columns)) for name, series in numbers["series"].items()],
    )
    ranks = Table(
        caption="Mean probability of each rank over all points, by the learned receiver.",
        columns={"Tower": HEAD, **{f"rank {rank}": 2 for rank in RANKS}},
        rows=[(tower, *share.values()) for tower, share in numbers["ranks"].items()],
    )
    return Card(title="Levels", id="series", tables=[levels, ranks])


def _model_card(data: PredictionPage) -> Card:
    chosen = bold(data.chosen["title"])
    if not data.candidates:
        text = paragraph(
            "No flight is named:", Markup("{}.").format(chosen), "The standard deviation includes the gains of both "
            "antennas, the shadowing and the offset of a new flight, and fading.",
        )  # fmt: skip
        return Card(title="Model", id="model", text=[text])
    errors = Table(
        caption=f"Errors of 4 s means on held-out {data.chosen['left_out']} [dB], without the mean of each flight.",
        columns={"Model": HEAD, "Residual field": TEXT, "RMSE": 2, "CRPS": 3},
        look="dense",
        rows=[(row["base"], row["field"], row["rmse_db"], row["crps_db"]) for row in data.candidates],
    )
    scales = Table(caption="Fitted values.", columns={"Name": HEAD, "Value": 2}, rows=list(data.model.items()))
    text = paragraph(
        "Selected by errors on held-out parts of the named flights:",
        Markup("{}.").format(chosen),
        f"Standard deviations are multiplied by {number(data.chosen['sd_factor'], 2)}, the ratio of observed to stated "
        "errors on these parts.",
    )
    parts = [Card(title="Residual field: strengths and scales", fold=True, tables=[scales])]
    return Card(title="Model", id="model", text=[text], tables=[errors], parts=parts)


# Number of rows of prediction.csv that are written together, which limits the memory.
_ROWS_AT_ONCE = 100_000


def write_prediction(data: PredictionPage, folder: Path) -> tuple[list[Path], list[str]]:
    """Write the page and its files. Return their paths, and the reasons why a file could not be written.

    Parameters
    ----------
    data : PredictionPage
    folder : Path

    Returns
    -------
    files : list of Path
        The page is the first.
    said : list of str
        Why prediction.nc was not written; empty if it was.
    """
    numbers = prediction_metrics(data)
    flown = [np.asarray(line).T for line in data.flown.values()]
    note = "Solid lines: the flights from which the prediction is learned." if flown else ""
    shown = payload(list(_groups(data)), data.site, lines=flown, note=note)
    written = write_page(folder, "prediction", prediction_page(data, numbers, shown), numbers)
    digits = {c: 3 for c in data.table.columns if c.endswith(("_db", "_m", "_deg", "_s"))}
    digits |= {c: 4 for c in data.table.columns if c.startswith("p_")}
    with (folder / "prediction.csv").open("w", encoding="utf-8", newline="") as book:
        for start in range(0, len(data.table), _ROWS_AT_ONCE):
            part = guarded(data.table.iloc[start : start + _ROWS_AT_ONCE].round(digits))
            part.to_csv(book, index=False, header=not start, lineterminator="\n")
    written.append(folder / "prediction.csv")
    try:
        written.append(write_file(folder / "prediction.nc", bytes(netcdf_bytes(_dataset(data)))))
    except UsageError as missing:
        return written, [str(missing)]
    return written, []


def _dataset(data: PredictionPage) -> Dataset:
    """Return the levels over (tower, channel, time), or over (tower, channel, point) if positions have no times."""
    series = [part for _, part in data.series]
    first, time = series[0], series[0]["time_s"].to_numpy(np.float64)
    timed = data.kind == "route" and bool((np.diff(time) > 0.0).all())
    along = "time" if timed else "point"
    meaning = "seconds since the start of the route (date unknown)" if timed else "number of the position"
    axis = time if timed else np.arange(len(time), dtype=np.int32)
    variables: dict[str, Any] = {along: (along, axis, {"long_name": meaning, "units": "s" if timed else "1"})}
    links = data.levels[["tower", "channel"]].astype(str)
    labels = {name: list(dict.fromkeys(links[name])) for name in ("tower", "channel")}
    for name, texts in labels.items():
        variables[name] = (name, np.array(texts, dtype=object), {"long_name": f"name of the {name}"})
    for name, unit in (("east_m", "m"), ("north_m", "m"), ("height_m", "m"), ("yaw_deg", "degree")):
        variables[name] = (along, first[name].to_numpy(np.float64), {"units": unit, "long_name": name})
    at = [tuple(labels[n].index(str(part[n].iloc[0])) for n in labels) for part in series]
    ends = ("level_db", "sd_db", "slow_sd_db", "q05_db", "q95_db")
    for name in (*ends, "p_serving", "p_lock", "locked_db", "locked_sd_db", "lost_db", "lost_sd_db"):
        if name in first:
            # the values of a channel that a tower does not have remain NaN
            values = np.full((*map(len, labels.values()), len(axis)), np.nan, dtype=np.float32)
            for place, part in zip(at, series, strict=True):
                values[place] = part[name]
            about = {"units": DB, "comment": "unit: dB"} if name.endswith("_db") else {"units": "1"}
            variables[name] = ((*labels, along), values, {"long_name": name, **about})
    variables["level_db"][2]["comment"] = ", ".join(f"{name}: {unit}" for name, unit in data.units.items())
    attributes = file_attributes(
        f"Predicted levels, {data.name}",
        f"{data.chosen['title']}, learned from {', '.join(data.flights)}",
        data.verdict,
    )
    return Dataset(variables, attributes)


def _groups(data: PredictionPage) -> Iterator[Places]:
    """Yield the values of each tower and channel, and of ranks, at each height of a grid or at all points."""
    groups: list[tuple[str, dict[str, ArrayLike], pd.DataFrame]] = []
    for name, part in data.series:
        level = {f"level [{data.units.get(name, 'dB')}]": part["level_db"], "standard deviation [dB]": part["sd_db"]}
        if "p_lock" in part and part["p_lock"].notna().any():
            level["probability of lock"] = part["p_lock"]
        groups.append((name, {**level, BAND[0]: part["q05_db"], BAND[1]: part["q95_db"]}, part))
    ranks = data.table[data.table["channel"] == "rank"]
    for tower, part in ranks.groupby("tower", sort=False, observed=True):
        chance = part[[f"p_rank{k}" for k in RANKS]].to_numpy(np.float64)
        likeliest = np.where(np.isfinite(chance).all(axis=1), 1 + chance.argmax(axis=1), np.nan)
        each = {f"probability of rank {k}": chance[:, i] for i, k in enumerate(RANKS)}
        groups.append((f"{tower} rank", {LIKELIEST: likeliest, **each}, part))
    for name, values, part in groups:
        at = part[["east_m", "north_m", "height_m"]].to_numpy(np.float64)
        size = len(part) if data.shape is None else data.shape[0] * data.shape[1]
        for k, start in enumerate(range(0, len(part), max(size, 1))):
            some = slice(start, start + size)
            yield Places(
                name=name if data.shape is None else f"{name}, {data.heights_m[k]:g} m",
                at=at[some],
                values={key: np.asarray(column)[some] for key, column in values.items()},
                cell_m=0.0 if data.shape is None else float(np.ptp(at[:size, 0])) / max(data.shape[1] - 1, 1),
                time_s=part["time_s"].to_numpy(np.float64) if data.kind == "route" else None,
            )
