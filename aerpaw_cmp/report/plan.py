"""The page plan.html with its metrics.json, the files of the recommended route, and the map of expected SDs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.jsonable import json_object
from ..common.text import guarded
from ..common.units import FloatArray
from ..site.site import Site
from .cards import HEAD, TEXT, Card, Page, Positions, Table, write_page
from .page import Made, about, write_file
from .places import COMPASS, Places, payload
from .texts import minute, number


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanPage(Made):
    """The content of the page of ``plan``.

    ``candidates`` and ``curve`` are rows of metrics.json. ``outline_m`` (k, 2) and ``holes_m`` limit the area in which
    a route may run [m]. ``track_m`` (n, 3) is the recommended route. ``place_m`` (m, 3) are the points of the target,
    and ``before_db`` and ``after_db`` (m,) the standard deviations at them [dB]. If the target is all directions, the
    points are directions from ``seen_from_m`` (3,).
    """

    target: str
    sentence: str
    antennas: Sequence[str]
    flights: Sequence[str]
    candidates: Sequence[Mapping[str, Any]]
    curve: Sequence[Mapping[str, float]]
    outline_m: FloatArray
    holes_m: Sequence[FloatArray]
    track_m: FloatArray
    place_m: FloatArray
    before_db: FloatArray
    after_db: FloatArray
    seen_from_m: FloatArray | None
    site: Site
    files: Mapping[str, str]
    warnings: Sequence[str]


def _sd_now_db(data: PlanPage) -> float:
    """Return the root mean square of the standard deviations before the flight [dB]."""
    return float(np.sqrt(np.mean(data.before_db**2)))


def plan_metrics(data: PlanPage) -> dict[str, Any]:
    """Return the numbers of metrics.json."""
    return json_object(
        target=data.target, sentence=data.sentence, antennas=data.antennas, flights=data.flights,
        candidates=data.candidates, warnings=data.warnings,
        sd_now_db=_sd_now_db(data),
        length=data.curve,
        **about(data),
    )  # fmt: skip


def plan_page(data: PlanPage, shown: Mapping[str, Any]) -> Page:
    """Return the page. ``shown`` is the data of its map."""
    candidates = Table(
        caption="Expected standard deviation (SD) over the target after each flight, best first; now "
        f"{number(_sd_now_db(data), 1, 'dB')}.",
        columns={"Route": HEAD, "SD [dB]": 1, "Length [km]": 1, "Time [min]": 1, "May be flown": TEXT},
        rows=[(c["name"], c["sd_db"], c["length_m"] / 1000, c["minutes"], c["refused"] or "yes")
              for c in data.candidates],
        notes=["The SD is the expected error of the levels that are predicted for a later flight, after one offset, "
               "without the shadowing, fading and noise of that flight. It depends on positions and headings, not on "
               "the levels that will be measured. Use it to choose a flight, not single waypoints: routes whose "
               "waypoints were chosen by it were not better than a lawnmower of the same length."],
    )  # fmt: skip
    curve = Table(
        caption="Expected standard deviation by flight time, after the best of three candidates of that length.",
        columns={"Time [min]": 1, "Length [km]": 1, "SD [dB]": 1},
        rows=[(p["minutes"], p["length_m"] / 1000, p["sd_db"]) for p in data.curve],
    )
    target = data.target if data.seen_from_m is None else "all directions around the towers, at all headings"
    known = f"Known flights: {', '.join(data.flights)}."
    if not data.flights:
        known = "No flight was named, so the gains of both antennas are unknown."
    return Page(
        kind="plan", title=f"Next flight for {target}", verdict=data.sentence, cautions=data.warnings,
        about=[f"{known} Channels: {', '.join(data.antennas)}. Made {minute(data.generated)}. "
               "QGroundControl opens route.plan; route.csv has the same waypoints."],
        cards=[Card(title="Target and route", positions=Positions(view="places", data=shown)),
               Card(title="Candidates", id="candidates", tables=[candidates]),
               Card(title="Flight time", id="length", tables=[curve])],
    )  # fmt: skip


def write_plan(data: PlanPage, folder: Path) -> list[Path]:
    """Write the page and its files, and return their paths, beginning with the page."""
    shown = payload(
        list(_groups(data)), data.site, lines=[data.track_m], rings=[data.outline_m, *data.holes_m],
        note="Solid line: the recommended route. Dashed lines: limits of the allowed area.",
    )  # fmt: skip
    written = write_page(folder, "plan", plan_page(data, shown), plan_metrics(data))
    written += [write_file(folder / name, text) for name, text in data.files.items()]
    columns = dict(zip(("east_m", "north_m", "height_m"), data.place_m.T, strict=True))
    table: pd.DataFrame = pd.DataFrame({**columns, "sd_before_db": data.before_db, "sd_after_db": data.after_db})
    guarded(table.round(3)).to_csv(folder / "sd_map.csv", index=False, lineterminator="\n")
    return [*written, folder / "sd_map.csv"]


def _groups(data: PlanPage) -> Iterator[Places]:
    """Yield the proposed route, and then the target, which consists of positions or of directions from a tower.

    The values of each point of the target are averaged over all headings.
    """
    yield Places(name="proposed route", at=data.track_m, values={"height [m]": data.track_m[:, 2]})
    _, first, member = np.unique(data.place_m.round(1), axis=0, return_index=True, return_inverse=True)
    count = np.bincount(member.ravel())
    now, after = (np.sqrt(np.bincount(member.ravel(), v**2) / count) for v in (data.before_db, data.after_db))
    values = {"standard deviation now [dB]": now, "standard deviation after the flight [dB]": after}
    place = data.place_m[first]
    if data.seen_from_m is None:
        yield Places(name="target", at=place, values=values)
    else:
        away = place - data.seen_from_m
        unit = away / np.linalg.norm(away, axis=1, keepdims=True)
        yield Places(name="directions from the tower", at=unit, values=values, around=COMPASS)
