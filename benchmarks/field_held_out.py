"""What carries over to flights that had no part: the held-out part of reports/lake_wheeler.

RSS of three data sets by `calibrate`, rank by a receiver fitted on the other flight, SNR per tower, and every folder of
the field data with what is read there and why the rest is not compared.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rank_receiver

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.compare import calibration
from aerpaw_cmp.compare.calibration import Score
from aerpaw_cmp.flight.data import gather, read_logs
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.calibrate import Calibration, calibrate
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.logs.ingest import Ingested, ingest
from aerpaw_cmp.logs.readers import ReadOptions

FOLDER = Path(__file__).parents[1] / "tests" / "field"
CALIBRATIONS = {
    "dataset12": "LW1, 3.3 GHz, 40 and 70 m, measured patterns",
    "lte": "LW1, 3.51 GHz, 50 and 90 m, heading from the track",
    "afar": "a ground node, 3.32 GHz, six search flights",
}
SNR_FLIGHT = "aadm"
NOT_COMPARED = {
    "telemetry": "tracks of the other folders' flights, and of flights without a radio log",
    "modem": "transcripts of modems without a place: they test the tap and the readers",
    "srsran": "consoles of UEs and base stations without positions of their own; rank shares only",
    "pawprints": "cells of public networks, whose masts are not on the site's map",
    "nemo": "cells of public networks, whose masts are not on the site's map",
    "urban_lte": "another city, whose map and masts are not known",
    "antennas": "measured patterns, used by dataset12",
}
"""Why a folder has no row above; folders that are neither here nor compared are said to be new."""
COMPARED = {
    "dataset12": "RSS, above", "lte": "RSS, above", "afar": "RSS, above", "sounder": "RSS, with afar",
    "nr_rank": "rank, above", "aadm": "SNR, above",
}  # fmt: skip


def rss(root: Path) -> dict[str, Any]:
    """Scores of every calibration, by split, with what its page says in words."""
    out = {}
    for name, words in CALIBRATIONS.items():
        found = calibrate(FOLDER / "calibrations" / f"{name}.yaml", logs_root=root)
        out[name] = {"what": words, "flights": len(found.flights), "words": list(found.words)} | {
            "splits": {split: means(scores) for split, scores in found.scores.items() if scores},
            "controls": {control: means(scores) for control, scores in found.controls.items() if scores},
            "each": [each(score) for score in found.scores["flight_left_out"]],
            "mounts": mounts(found),
        }
    return out


def means(scores: Sequence[Score]) -> dict[str, float]:
    """Means over flights and channels [dB]."""
    return {
        key: calibration.mean_rmse(scores, key) for key in ("rmse_db", "rmse_4s_db", "free_space_rmse_db")
    }  # fmt: skip


def each(score: Score) -> dict[str, Any]:
    """One flight and channel."""
    return {
        "flight": score.flight, "tower": score.tower, "channel": score.channel, "n": score.n, "rmse_db": score.rmse_db,
        "rmse_4s_db": score.rmse_4s_db, "free_space_rmse_db": score.free_space_rmse_db,
        "inside_90": score.inside_90,
    }  # fmt: skip


def mounts(found: Calibration) -> dict[str, Any]:
    """Azimuths with their standard deviation [deg]."""
    return {
        name: {"azimuth_deg": m.azimuth_deg, "sd_deg": m.azimuth_sd_deg, "identified": m.identified}
        for name, m in found.learned.mounts.items()
    }


def rank(root: Path, replicates: int, step_deg: float) -> dict[str, Any]:
    """The receiver fitted on one NR flight, scored on the other."""
    found = rank_receiver.table(root, step_deg, replicates, ("power_sum",))
    ways = found["ways"]["power_sum"]
    return {
        way: {
            "headline": row["rows"][rank_receiver.HEADLINE],
            "geometry": row["geometry"],
            "candidates": row["candidates"],
            "tied": row["tied"],
            "sector_left_out": row["sector_left_out"],
        }
        for way, row in ways.items()
    } | {"repeat": found["repeat"]}


def snr(root: Path) -> dict[str, Any]:
    """SNR per tower, after one offset each."""
    settings = load_flight(FOLDER / f"{SNR_FLIGHT}.yaml")
    data = gather(settings, FOLDER, read_logs(settings, FOLDER, root), root)
    return {
        one.tower: {
            "n": one.score.n,
            "rmse_db": one.score.rmse_db,
            "offset_db": one.score.offset_db,
            "correlation": one.score.correlation,
            "free_space_rmse_db": one.baselines["free_space"].rmse_db,
            "spread_db": float(np.nanstd(one.measured_db)),
        }
        for one in run_flight(data, audit=False).result.rss
    }


def folders(root: Path) -> dict[str, Any]:
    """Per folder: files, by which reader, lines, and what was compared."""
    out = {}
    for folder in sorted(p for p in root.iterdir() if p.is_dir()):
        try:
            found = ingest(folder, options=ReadOptions(timezone="America/New_York"))
        except InputError:  # nothing in it is a log
            found = Ingested()
        files = list(found)
        out[folder.name] = {
            "files": len(files),
            "readers": dict(Counter(f.result.reader for f in files)),
            "lines": sum(f.result.lines for f in files),
            "rejected": sum(f.result.rejected_count for f in files),
            "not_read": sum(p.is_file() for p in folder.rglob("*")) - len({f.path for f in files}),
            "compared": COMPARED.get(folder.name) or NOT_COMPARED.get(folder.name, "new here: not compared yet"),
        }
    return out


def table(root: Path, replicates: int, step_deg: float) -> dict[str, Any]:
    """All of it."""
    return {
        "rss": rss(root), "rank": rank(root, replicates, step_deg), "snr": snr(root), "folders": folders(root)
    }  # fmt: skip


# --- in words -------------------------------------------------------------------------------------------------------

SPLITS = {
    "flight_left_out": "the flight", "altitude_left_out": "and its height", "heading_left_out": "and its headings",
    "sector_left_out": "and its directions", "route_left_out": "a stretch of route alone",
}  # fmt: skip


def num(value: Any, digits: int = 2) -> str:
    """A number, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def rows_of_rss(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: one per data set and split, free space on the same samples beside it."""
    rows = []
    for name, one in found["rss"].items():
        for split, words in SPLITS.items():
            if score := one["splits"].get(split):
                first = f"{name}: {one['what']}" if split == "flight_left_out" else ""
                cells = [num(score[k]) for k in ("free_space_rmse_db", "rmse_db", "rmse_4s_db")]
                rows.append([first, words, *cells])
        for control, score in one["controls"].items():
            rows.append(["", f"control: {control}", num(score["free_space_rmse_db"]), num(score["rmse_db"]),
                         num(score["rmse_4s_db"])])  # fmt: skip
    return ["data", "what the fit did not see", "free space", "learned", "over 4 s"], rows


def rows_of_flights(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: each flight and channel from the others."""
    rows = [
        [f"{e['flight']}, {e['tower']} {e['channel']}", str(e["n"]), num(e["free_space_rmse_db"]), num(e["rmse_db"]),
         num(e["rmse_4s_db"]), f"{100 * e['inside_90']:.0f} %"]
        for one in found["rss"].values() for e in one["each"]
    ]  # fmt: skip
    return ["flight", "samples", "free space", "learned", "over 4 s", "inside 90 %"], rows


def rows_of_rank(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: one per way."""
    rows = []
    for way, one in found["rank"].items():
        if way == "repeat":
            continue
        s = one["headline"]
        rows.append([
            way, f"{num(s['kappa'])} [{num(s['kappa_ci95'][0])}, {num(s['kappa_ci95'][1])}]", num(s["agreement"]),
            num(s["majority_agreement"]), f"{100 * s['log_score_gain']:.1f} %", num(s["total_variation_expected"], 3),
            f"{one['tied']} of {one['candidates']}",
        ])  # fmt: skip
    return ["fitted, scored", "kappa", "agreement", "always the commonest", "log score below the constant",
            "total variation", "geometries that tie"], rows  # fmt: skip


def rows_of_snr(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: one per tower."""
    rows = [
        [tower, str(s["n"]), num(s["spread_db"]), num(s["free_space_rmse_db"]), num(s["rmse_db"]),
         num(s["correlation"])]
        for tower, s in found["snr"].items()
    ]  # fmt: skip
    return ["tower", "samples", "spread of the SNR", "free space", "replay", "correlation"], rows


def rows_of_folders(found: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Header and rows: one per folder."""
    rows = [
        [name, str(f["files"]), str(f["not_read"]), str(f["lines"]), str(f["rejected"]),
         ", ".join(f"{r} {n}" if n > 1 else r for r, n in f["readers"].items()), f["compared"]]
        for name, f in found["folders"].items()
    ]  # fmt: skip
    return ["folder", "read", "no log", "lines", "rejected", "readers", "compared"], rows
