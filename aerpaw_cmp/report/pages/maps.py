"""map.html of the `map` job, with metrics.json and the figures beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...common.jsonable import json_object, json_safe, named
from ..content.flight import RANKS
from ..content.made import about
from ..content.maps import MapError, MapsData
from ..figures import maps as maps_figures
from ..figures.charts import flown
from ..kit import canvas
from ..kit.files import json_text, merge, write_file
from ..kit.page import embedded, rendered
from ..names import k_key
from ..words.maps import first_words, notes, warnings
from .maps_explorer import layer_numbers, page_layers, payload


def maps_metrics(data: MapsData) -> dict[str, Any]:
    """The numbers of the page under stable names; ``data.metrics`` is merged in last."""
    columns, rows = len(data.east_m), len(data.north_m)
    numbers = json_object(
        name=data.name,
        title=data.title,
        site=named(data.site, "name credit assumed"),
        grid={"columns": columns, "rows": rows, "positions": columns * rows},
        coverage=[named(m, "tower antennas foliage altitude_m coverage") for m in data.rss],
        rank=[
            {
                **named(m, "k foliage altitude_m"),
                "share": dict(zip(("Z", *map(str, RANKS)), m.share, strict=True)),
            }
            for m in data.rank
        ],
        layers=[layer_numbers(layer) for layer in page_layers(data)],
        mae=[named(e, "evaluation method k altitude_m mae mae_ci95 n") for e in data.errors],
        paper=[named(p, "where what paper ours") for p in data.paper],
        warnings=warnings(data),
        **about(data),
    )
    merge(numbers, json_safe(data.metrics))
    return numbers


def coverage_table(data: MapsData) -> tuple[list[str], list[tuple[list[str], list[float | None]]]]:
    """Column heads (heights) and rows (antennas, foliage, tower; share per height)."""
    heights = sorted({m.altitude_m for m in data.rss})
    rows = []
    for key, maps in maps_figures.grouped(data.rss, lambda m: (m.antennas, m.foliage, m.tower)).items():
        share = {m.altitude_m: m.coverage for m in maps}
        rows.append(([str(part) for part in key], [share.get(h) for h in heights]))
    return [f"{h:g} m" for h in heights], rows


def error_tables(
    errors: Sequence[MapError],
) -> list[tuple[str, list[str], list[tuple[str, str, list[float | None], float]]]]:
    """Per evaluation: title, heights, and rows of (method, K, MAE per height, mean over heights)."""
    result = []
    for evaluation, members in maps_figures.grouped(errors, lambda e: e.evaluation).items():
        heights = sorted({e.altitude_m for e in members})
        rows = []
        for (method, k), group in maps_figures.grouped(members, lambda e: (e.method, e.k)).items():
            mae = {e.altitude_m: e.mae for e in group}
            mean = sum(mae.values()) / len(mae)
            rows.append((method, k_key(k), [mae.get(h) for h in heights], mean))
        result.append((evaluation, [f"{h:g} m" for h in heights], rows))
    return result


def maps_page(data: MapsData, files: Sequence[str]) -> str:
    """The whole page."""
    charts = [chart for plate in maps_figures.plates(data) for chart in plate.charts]
    charts += [chart for flight in data.flights for chart in flown(flight)]
    linked = payload(data, charts) if data.rss or data.rank or data.layers else None
    return rendered(
        "map",
        ("common.js", "map_explorer.js") if linked else (),
        data=data,
        verdict=first_words(data),
        warnings=warnings(data),
        notes=notes(data),
        charts=charts,
        coverage=coverage_table(data),
        errors=error_tables(data.errors),
        files=files,
        explorer=embedded(linked),
    )


def write_maps(data: MapsData, folder: str | Path, drawn: str = "none") -> list[Path]:
    """Write ``map.html``, ``metrics.json`` and figures in one format, all or none; gives the files, the page first."""
    folder = Path(folder)
    written = [write_file(folder / "metrics.json", json_text(maps_metrics(data)))]
    specs = [] if drawn == "none" else maps_figures.figure_specs(data)
    formats = canvas.FORMATS if drawn == "all" else (drawn,)
    _, files = canvas.write_figures(specs, folder / "figures", formats)
    page = write_file(folder / "map.html", maps_page(data, ["metrics.json"]))
    return [page, *written, *files]
