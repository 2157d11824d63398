"""Numbers of a season from the rows of a campaign: held-out errors, ranking, steps of offsets, residuals by place."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from ...common.errors import InputError, parsing
from ...common.files import LARGEST_TABLE, read_bounded
from ...common.units import FloatArray
from ...compare.judge import season
from ...compare.judge.steps import NightOffsets, NodeOffset, node_offsets, stepped
from ...compare.statistics.passes import cell_means
from ...logs.ingest import ingest
from ...logs.readers import ReadOptions
from ...logs.records import has_wall_clock
from ...report.campaign import CampaignData, PlaceMap, RssRow, Season, SettingRank

_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)


def with_season(
    data: CampaignData, reports: Mapping[str, str] | None = None, sounded: Sequence[NodeOffset] = ()
) -> CampaignData:
    """The campaign with held-out errors in its rows and what they say over the season.

    Parameters
    ----------
    data : CampaignData
    reports : mapping of str to str, optional
        Address of the report of a flight, against the campaign's folder.
    sounded : sequence of NodeOffset
        Of soundings between towers (:func:`soundings`), in place of the offsets of the flights.
    """
    rows = _held_out_rows(data.rss)
    data = dataclasses.replace(data, rss=tuple(rows))
    if not rows:
        return dataclasses.replace(data, season=Season(reports=dict(reports or {}), nodes=tuple(sounded)))
    started = _started_of(rows)
    order = sorted(data.flights, key=lambda name: (name not in started, started.get(name, 0)))
    links = list(dict.fromkeys(row.link for row in rows))
    ranking = rank_settings(rows, list(data.settings), order, "")
    if len(links) > 1:
        for link in links:
            ranking += rank_settings([r for r in rows if r.link == link], list(data.settings), order, link)
    return dataclasses.replace(
        data,
        season=Season(
            held_out=any(np.isfinite(row.held_out_rmse_db) for row in rows),
            started={name: _iso(ns) for name, ns in started.items()},
            ranking=tuple(ranking),
            nodes=tuple(sounded) or _flown(data.reference_rows, order, started),
            places=_place_map(data.reference_rows, data.cell_m),
            reports=dict(reports or {}),
        ),
    )


def _started_of(rows: Iterable[RssRow]) -> dict[str, int]:
    """First instant of each flight [ns after 1970-01-01]; none where its logs have relative times only."""
    starts: dict[str, int] = {}
    for row in rows:
        if row.start_ns and has_wall_clock(np.datetime64(row.start_ns, "ns")):
            starts[row.flight] = min(row.start_ns, starts.get(row.flight, row.start_ns))
    return starts


def _iso(ns: int) -> str:
    return str(np.datetime64(ns, "ns").astype("datetime64[s]")) + "Z"


# --- held-out errors --------------------------------------------------------------------------------------------------


def _held_out_rows(rows: Sequence[RssRow]) -> list[RssRow]:
    """Rows with the offset from the other flights of their setting, tower and channel, and what it leaves."""
    groups: dict[tuple[str, str, str, str], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row.setting, row.tower, row.channel, row.unit), []).append(i)
    scored = list(rows)
    for members in groups.values():
        mine = [rows[i] for i in members]
        mean = np.array([row.moments.mean_db for row in mine])
        offset = season.left_out_offsets(
            [row.n if np.isfinite(m) else 0 for row, m in zip(mine, mean, strict=True)],
            mean,
            span_db=(min(row.span_db[0] for row in mine), max(row.span_db[1] for row in mine)),
        )
        error = season.error_at_offset(offset, [row.rmse_db for row in mine], [row.offset_db for row in mine], mean)
        for i, o, e in zip(members, offset, error, strict=True):
            scored[i] = dataclasses.replace(rows[i], held_out_offset_db=float(o), held_out_rmse_db=float(e))
    return scored


def _error_of(row: RssRow) -> float:
    """The error that settings are ranked by [dB]: held out, or own where there is no other flight."""
    return row.held_out_rmse_db if np.isfinite(row.held_out_rmse_db) else row.rmse_db


# --- settings ---------------------------------------------------------------------------------------------------------


def rank_settings(
    rows: Iterable[RssRow], settings: Sequence[str], flights: Sequence[str], link: str
) -> list[SettingRank]:
    """Settings by their mean error over flights, and their difference to the first on the same flights and links.

    Parameters
    ----------
    rows : iterable of RssRow
    settings : sequence of str
        Labels; ties keep their order.
    flights : sequence of str
        Those that are compared.
    link : str
        What the rows are of, for the record.

    Returns
    -------
    list of SettingRank
        Least mean error first; settings without a finite error are left out.
    """
    table: dict[str, dict[str, dict[str, float]]] = {name: {} for name in settings}
    for row in rows:
        if np.isfinite(_error_of(row)):
            table[row.setting].setdefault(row.flight, {})[row.link] = _error_of(row)
    means = {name: np.array([np.mean(list(by.values())) for by in table[name].values()]) for name in settings}
    known = sorted((name for name in settings if len(means[name])), key=lambda name: float(means[name].mean()))
    choices = []
    for name in known:
        difference = season.mean_of_flights(_paired(table[name], table[known[0]], flights))
        low, *middle, high = (float(v) for v in np.quantile(means[name], (0.0, *_QUANTILES, 1.0)))
        choices.append(
            SettingRank(
                setting=name,
                link=link,
                n_flights=len(means[name]),
                mean_db=float(means[name].mean()),
                quantiles_db=(low, *middle, high),
                difference_db=difference.mean,
                difference_ci95_db=None if name == known[0] else (difference.low, difference.high),
                n_paired=difference.n,
                verdict="first" if name == known[0] else season.verdict_of(difference),
            )
        )
    return choices


def _paired(errors: Mapping[str, Any], base: Mapping[str, Any], flights: Sequence[str]) -> FloatArray:
    """Mean difference on the links that both settings scored, per flight, in the order of the dates."""
    differences = []
    for flight in flights:
        links = sorted(set(errors.get(flight, ())) & set(base.get(flight, ())))
        if links:
            differences.append(float(np.mean([errors[flight][link] - base[flight][link] for link in links])))
    return np.array(differences)


# --- steps of offsets -------------------------------------------------------------------------------------------------


def _flown(rows: Sequence[RssRow], order: Sequence[str], started: Mapping[str, int]) -> tuple[NodeOffset, ...]:
    """Offset of each tower and channel over the flights, less what all share on a flight, and its steps."""
    known = {(row.flight, row.link): row.moments.mean_db for row in rows}
    links = list(dict.fromkeys(row.link for row in rows))
    offsets = np.array([[known.get((flight, link), np.nan) for link in links] for flight in order])
    dates = [_iso(started[flight]) if flight in started else flight for flight in order]
    nodes = node_offsets(offsets, [("", link) for link in links])
    return tuple(stepped(name.removesuffix(" receives"), dates, values, len(nodes)) for name, values in nodes.items())


def soundings(paths: Sequence[Path], timezone: str | None) -> tuple[NodeOffset, ...]:
    """Offset of each radio of the towers, night by night (UTC), from soundings between them.

    Parameters
    ----------
    paths : sequence of Path
        Logs, their folders, or a flight file of ``ingest -o``. Streams that name transmitter and receiver count.
    timezone : str, optional
        Of logs with local times.

    Raises
    ------
    InputError
        No log names a link.
    """
    levels = []
    for file in ingest(paths, options=ReadOptions(timezone=timezone)):
        for stream in file.result.streams:
            link = stream.attributes
            if stream.kind == "rss" and link.get("unit") != "dB" and {"transmitter", "receiver"} <= link.keys():
                night = stream.frame["time"].dt.strftime("%Y-%m-%d")
                ends = {end: _radio(link, end) for end in ("transmitter", "receiver")}
                by_night = stream.frame["rss_db"].groupby(night).median()
                levels.append(pd.DataFrame({**ends, "band": link.get("frequency_hz", np.nan), "offset": -by_night}))
    if not levels:
        raise InputError("no log names transmitter and receiver", expected="soundings", path=paths[0])
    table = pd.concat(levels).rename_axis("night").reset_index()
    nights = sorted(table["night"].unique())
    nodes: dict[str, NightOffsets] = {}
    for band, part in table.groupby("band", dropna=False):
        wide = part.pivot_table("offset", "night", ["transmitter", "receiver"], aggfunc="median").reindex(nights)
        name = f"{band / 1e6:.0f} MHz, " if np.isfinite(band) else ""
        nodes |= {name + node: values for node, values in node_offsets(wide.to_numpy(), list(wide.columns)).items()}
    return tuple(stepped(node, nights, values, len(nodes)) for node, values in nodes.items())


def _radio(link: Mapping[str, Any], end: str) -> str:
    """Tower, serial number and channel of one end of a link, where the log has them."""
    serial, channel = link.get(f"{end}_serial_number"), link.get(f"{end}_channel")
    return str(link[end]) + (f" {serial}" if serial else "") + (f":{channel}" if channel else "")


# --- places -----------------------------------------------------------------------------------------------------------


def _place_map(rows: Sequence[RssRow], cell_m: float) -> PlaceMap | None:
    """Mean residual of each cell of the plan over flights, towers and channels; None without a cell."""
    residuals: dict[tuple[int, int], list[float]] = {}
    for row in rows:
        scored = np.isfinite(row.residual_db) & np.isfinite(row.position_m).all(axis=1)
        cells, means, _ = cell_means(row.position_m, row.residual_db, scored, cell_m)
        for (east, north), residual in zip(cells.tolist(), means, strict=True):
            residuals.setdefault((east, north), []).append(residual)
    if not residuals:
        return None
    return PlaceMap(cells=np.array(list(residuals)), mean_db=np.array([np.mean(v) for v in residuals.values()]))


# --- reports of the flights -------------------------------------------------------------------------------------------


def find_reports(flights: Iterable[str], folder: Path, places: Sequence[Path]) -> dict[str, str]:
    """Relative addresses of the reports of flights that stand in one of the folders ``places``.

    Parameters
    ----------
    flights : iterable of str
    folder : Path
        Of the campaign's page.
    places : sequence of Path
        Each may hold ``NAME/report.html``, as ``aerpaw-cmp report`` writes it.

    Returns
    -------
    dict
        A folder whose metrics.json is of another flight is no report of this one.
    """
    reports: dict[str, str] = {}
    for name in flights:
        for place in places:
            page = place / name / "report.html"
            if page.is_file() and _flight_of(page.with_name("metrics.json")) == name:
                relative = Path(os.path.relpath(page.resolve(), folder.resolve())).as_posix()
                reports[name] = quote(relative)
                break
    return reports


def _flight_of(path: Path) -> str | None:
    try:
        with parsing(path, any_shape=True):
            name = json.loads(read_bounded(path, LARGEST_TABLE)).get("flight")
    except InputError:
        return None
    return name if isinstance(name, str) else None
