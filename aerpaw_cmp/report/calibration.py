"""The page calibration.html with its metrics.json: learned antennas, flown directions, and held-out scores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from ..common.jsonable import json_object
from ..common.units import FloatArray
from ..compare.calibration import BASELINES, Score, mean_rmse
from ..compare.verdict import Verdict, antenna_or_place, by_flight
from .cards import HEAD, RIGHT, SHARE, TEXT, Card, Page, Positions, Table, write_page
from .flight_words import sentence_of
from .page import Made, about
from .places import BODY, COMPASS, Places, payload
from .texts import minute, number, percent


@dataclass(frozen=True, slots=True, kw_only=True)
class AntennaMap:
    """The gain of one antenna over the sphere.

    Parameters
    ----------
    name : str
        Name, such as ``LW1.USRP1 tower``.
    directions : (t, p, 3)
        Unit vectors of the grid, from the zenith to the nadir.
    gain_dbi, sd_db : (t, p)
    level_db : float
        Level that was subtracted from the learned gain, so that its mean is 0 dBi.
    flown : (m, 3)
        Unit vectors of the directions that flights measured.
    """

    name: str
    directions: FloatArray
    gain_dbi: FloatArray
    sd_db: FloatArray
    level_db: float
    flown: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationData(Made):
    """The record of a calibration. Each row of ``scores`` and ``controls`` has a flight, tower, channel and RMSE."""

    name: str
    flights: Sequence[str]
    trained_on: Sequence[str]
    marks: Sequence[str]
    words: Sequence[str]
    warnings: Sequence[str]
    scores: Mapping[str, Sequence[Mapping[str, Any]]]
    controls: Mapping[str, Sequence[Mapping[str, Any]]]
    mounts: Mapping[str, Mapping[str, Any]]
    strengths: Mapping[str, Any]
    antennas: Sequence[AntennaMap]
    rank: Mapping[str, Any] | None = None
    settings_text: str = ""


ONE_FLIGHT = "A single flight cannot be scored. Next: `aerpaw-cmp calibrate FLIGHT FLIGHT` with a second flight."

# Sentence and next step, by the verdict of :func:`~aerpaw_cmp.compare.verdict.by_flight` on learned antennas.
HELPS: dict[str, tuple[str, str]] = {
    "better": (
        "The learned antennas are significantly better ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "`aerpaw-cmp report FLIGHT --with CALIBRATED` with another flight",
    ),
    "worse": (
        "The learned antennas are significantly worse ({effect:+.1f} dB, 95 %: {low:+.1f} to {high:+.1f} dB).",
        "do not use them in flight.yaml; check node, channel and gain of the logs",
    ),
    "not significant": (
        "The difference of {effect:+.1f} dB is not significant (95 %: {low:+.1f} to {high:+.1f} dB).",
        "add flights with different headings",
    ),
    "no interval": (
        "The difference is {effect:+.1f} dB; an interval requires three flights.",
        "`aerpaw-cmp calibrate FLIGHT FLIGHT FLIGHT` with a third flight",
    ),
}

# Sentence and next step, by the verdict of :func:`~aerpaw_cmp.compare.verdict.antenna_or_place` on the UAV's frame.
FRAMES: dict[str, tuple[str, str]] = {
    "antenna": (
        "The learned gain rotates with the UAV, as an antenna does: {where} the error is {size:.1f} dB larger "
        "(95 %: {near:.1f} to {far:.1f} dB).",
        "",
    ),
    "place": (
        "The learned gain depends on the positions, not on the antenna: {where} the error is {size:.1f} dB smaller "
        "(95 %: {near:.1f} to {far:.1f} dB).",
        "fly over the same places with different headings",
    ),
    "not separable": (
        "Effects of antenna and place cannot be separated: {where} the error differs by {size:.1f} dB, not "
        "significantly.",
        "",
    ),
    "no interval": ("Effects of antenna and place cannot be separated with two flights.", ""),
}

WRONG_FRAMES = {
    "world frame at the UAV": "in a frame fixed to the ground",
    "heading turned the wrong way": "with the heading rotated the wrong way",
}


def helps(scores: Sequence[Score]) -> Verdict:
    """Compare the learned antennas with the best baseline on held-out flights."""
    name = min(BASELINES, key=lambda key: mean_rmse(scores, key))
    return by_flight(_errors(scores), _errors(scores, name), name)


def frame(controls: Mapping[str, Sequence[Score]]) -> Verdict:
    """Test whether an antenna or the position explains the learned gain, without measured patterns."""
    body = _errors(controls.get("body frame, no patterns", ()))
    return antenna_or_place(
        [by_flight(body, _errors(controls.get(name, ())), where) for name, where in WRONG_FRAMES.items()]
    )


def _errors(scores: Sequence[Score], name: str = "rmse_db") -> list[tuple[str, float]]:
    return [(score.flight, getattr(score, name)) for score in scores]


def sentences(scores: Mapping[str, Sequence[Score]], controls: Mapping[str, Sequence[Score]]) -> tuple[str, ...]:
    """Return the summary for page and terminal, followed by details.

    Parameters
    ----------
    scores, controls : mapping of str to sequence of Score
        Scores by kind of held-out data, and scores of wrong or simpler models as controls.

    Returns
    -------
    tuple of str
    """
    left_out = scores["flight_left_out"]
    if not left_out:
        return (ONE_FLIGHT,)
    verdict, turned = helps(left_out), frame(controls)
    worst = max(left_out, key=lambda score: score.rmse_db)
    ends = sorted(map(abs, turned.interval))
    helped, _, step = sentence_of(verdict, HELPS).partition(" Next: ")
    first = (
        f"Held-out flights: RMSE {mean_rmse(left_out):.1f} dB with learned antennas; "
        f"{BASELINES[verdict.where]}: {mean_rmse(left_out, verdict.where):.1f} dB.",
        helped,
        f"Largest error: {worst.flight}, {worst.tower} {worst.channel}, {worst.rmse_db:.1f} dB.",
        sentence_of(turned, FRAMES, near=ends[0], far=ends[1]),
        f"Next: {step}" if turned.cause != "place" else "",
    )
    return (" ".join(text for text in first if text), *_further(scores))


def _further(scores: Mapping[str, Sequence[Score]]) -> Iterator[str]:
    left_out, sectors = scores["flight_left_out"], scores["sector_left_out"]
    if sectors:
        base, error = mean_rmse(sectors, "free_space_rmse_db"), mean_rmse(sectors)
        yield f"Directions that no training flight measured: RMSE {error:.1f} dB; free space: {base:.1f} dB."
        gain = mean_rmse(left_out, "free_space_rmse_db") - mean_rmse(left_out)
        if gain > 0:
            share = min(max((base - error) / gain, 0.0), 1.0)
            yield f"{100 * share:.0f} % of the improvement over free space remains in these directions."
    if not scores["heading_left_out"]:
        yield "No heading could be held out, because all flights have the same one."


SPLIT_TITLE = {
    "flight_left_out": "each flight",
    "altitude_left_out": "each flight and its cruising height",
    "heading_left_out": "each flight and an eighth of the headings",
    "sector_left_out": "each flight and a sector of 60 degrees at the tower",
    "campaign_left_out": "each campaign",
    "other_flights": "other flights (--score)",
}


def calibration_metrics(data: CalibrationData) -> dict[str, Any]:
    """Return the numbers of the page under stable names."""
    return json_object(
        calibration=data.name,
        flights=data.flights, trained_on=data.trained_on, marks=data.marks, scores=data.scores,
        controls=data.controls, mounts=data.mounts, strengths=data.strengths, words=data.words,
        warnings=data.warnings,
        antennas=[
            {"name": a.name, "share_of_sphere_seen": _share_seen(a), "n_bins": len(a.flown)} for a in data.antennas
        ],
        rank=data.rank or {},
        **about(data),
    )  # fmt: skip


def _share_seen(antenna: AntennaMap) -> float:
    """Return the share of the sphere within 10 degrees of a direction that a flight measured."""
    grid = antenna.directions
    near = np.zeros(grid.shape[:2], bool)
    for part in np.array_split(antenna.flown, max(1, len(antenna.flown) // 500)):
        near |= (grid @ part.T > np.cos(np.radians(10.0))).any(axis=-1)
    weight = np.hypot(grid[..., 0], grid[..., 1])  # proportional to the area of a cell, which is zero at a pole
    return float((near * weight).sum() / weight.sum())


def _mean(rows: Sequence[Mapping[str, Any]], key: str = "rmse_db") -> float:
    return float(np.mean([r[key] for r in rows])) if rows else float("nan")


def _groups(data: CalibrationData) -> Iterator[Places]:
    """Yield each antenna over the sphere."""
    for a in data.antennas:
        yield Places(
            name=a.name,
            at=a.directions.reshape(-1, 3),
            values={"gain [dBi]": a.gain_dbi.ravel(), "standard deviation [dB]": a.sd_db.ravel()},
            around=BODY if a.name.endswith(" uav") else COMPASS,
            dots=a.flown,
        )


def scores_card(data: CalibrationData) -> Card:
    """Return the card of held-out errors, by the kind of held-out data and by flight and channel."""
    each = {"as logged": 1, "4 s means": 1}
    baselines = dict.fromkeys(BASELINES.values(), 1)
    rows = {**data.scores, **{f"control: {name}": scores for name, scores in data.controls.items()}}
    keys = ("rmse_db", "rmse_4s_db", *BASELINES)
    means = Table(
        caption="RMSE in dB after one offset per flight and channel, mean over flights and channels. A dash means that "
        "these data could not be held out. Controls are the same fit in a wrong frame, and without measured patterns.",
        columns={"Held out": HEAD, **each, **baselines, "channels": 0},
        rows=[(SPLIT_TITLE.get(name, name), *(_mean(of, key) for key in keys), len(of)) for name, of in rows.items()],
    )
    every = Table(
        caption="RMSE in dB after the flight's own offset; \"offset of the training flights\": with their mean offset.",
        columns={"Held out": TEXT, "Flight": HEAD, "Tower": TEXT, "Channel": TEXT, **each,
                 "offset of the training flights": 1, **baselines, "samples": 0},
        rows=_rows(data.scores, ("flight", "tower", "channel", "rmse_db", "rmse_4s_db", "rmse_shared_offset_db",
                                 *BASELINES, "n")),
    )  # fmt: skip
    parts = [Card(title="Every flight and channel", fold=True, tables=[every])]
    return Card(title="Scores", id="scores", text=[data.words[1:]], tables=[means], parts=parts)


def _rows(splits: Mapping[str, Sequence[Mapping[str, Any]]] | None, keys: Sequence[str]) -> list[tuple[Any, ...]]:
    """Return one row per score: the kind of held-out data, followed by the numbers of ``keys``."""
    known = (splits or {}).items()
    return [(SPLIT_TITLE.get(split, split), *(row[key] for key in keys)) for split, of in known for row in of]


def mounts_card(data: CalibrationData) -> Card:
    """Return the card of the azimuths at which antennas with a measured pattern are mounted."""
    table = Table(
        caption="Mounts of antennas with a measured pattern; azimuth counter-clockwise from east (tower) or from the "
        "nose (UAV).",
        columns={"Antenna": HEAD, "azimuth": RIGHT, "sd": RIGHT, "identified": TEXT},
        rows=[(name, number(m["azimuth_deg"], 0, "deg"), number(m["azimuth_sd_deg"], 0, "deg"),
               "yes" if m["identified"] else "no") for name, m in data.mounts.items()],
    )  # fmt: skip
    return Card(title="Antennas", id="antennas", tables=[table])


def gains_card(data: CalibrationData) -> Card:
    """Return the card with the gain of each antenna over the sphere."""
    if not data.antennas:
        return Card()
    seen = ", ".join(f"{percent(_share_seen(a))} of the sphere of {a.name}" for a in data.antennas)
    text = (
        f"Flights measured directions within 10 degrees of {seen}. Elsewhere the gain is extrapolated, with a large "
        "standard deviation. The mean over the sphere is set to 0 dBi, because the offsets contain it."
    )
    shown = Positions(view="places", data=payload(list(_groups(data))))
    return Card(title="Gain of the antennas", positions=shown, text=[text])


def rank_card(data: CalibrationData) -> Card:
    """Return the card of the rank receiver's forecasts on held-out flights."""
    table = Table(
        caption="The receiver is fitted on the other flights. Log score in nats per report, lower is better. The "
        "constant forecast has the rank shares of the training flights. The total variation compares the expected and "
        "the measured histogram.",
        columns={"Held out": TEXT, "Flight": HEAD, "Tower": TEXT, "kappa": 2, "log score": 3, "constant": 3,
                 "total variation": 3, "agreement": SHARE, "most frequent rank": SHARE},
        rows=_rows(data.rank, ("flight", "tower", "kappa", "log_score", "constant_log_score",
                               "total_variation_expected",
                               "agreement", "majority_agreement")),
    )  # fmt: skip
    return Card(title="Rank", id="rank", tables=[table])


CARDS = (scores_card, mounts_card, gains_card, rank_card)


def write_calibration(data: CalibrationData, folder: Path) -> list[Path]:
    """Write ``calibration.html`` and ``metrics.json``."""
    settings = Markup('<pre tabindex="0" role="region" aria-label="Settings for flight.yaml">{}</pre>').format(
        data.settings_text
    )
    page = Page(
        kind="calibration", title=data.name, verdict=data.words[0] if data.words else "", cautions=data.warnings,
        about=[f"Flights: {', '.join(data.flights)}. Made {minute(data.generated)}"],
        cards=[*(card(data) for card in CARDS), Card(title="In flight.yaml", id="settings", text=[settings])],
    )  # fmt: skip
    return write_page(folder, "calibration", page, calibration_metrics(data))
