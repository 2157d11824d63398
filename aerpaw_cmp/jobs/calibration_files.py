"""Output of a calibration: antenna files, the settings that name them, the page, and entries for a site."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import KEY, MARKS, union
from ..common.gaussian import determining, gaussian_kernel
from ..common.units import spread_out
from ..common.yamlfile import dump_yaml
from ..compare.calibration import Score, cruise_height_m, mean_rmse
from ..compare.gains import Frame, Spread, directed, offset_sd_db
from ..flight.data import FlightData, RssSeries, quantity_of
from ..flight.training import flight_logs, marks_of
from ..logs.records import has_wall_clock
from ..report.calibration import AntennaMap, CalibrationData, calibration_metrics, write_calibration
from ..report.page import write_file
from ..report.texts import safe_name
from ..site import learned
from .calibrate import Calibration, CalibrationFile, direction_covariance
from .calibrate_rank import RankCalibration

# Start of calibrated.yaml, which identifies an earlier output of this tool.
_MARK = "# aerpaw-cmp calibrate"

# Share of the variance of the joint gain that the stored directions may miss, and the largest number of these
# directions.
_PAIR_SHARE, _MOST_PAIRS = 0.01, 400


def _antenna_maps(calibration: Calibration) -> dict[tuple[str, str], AntennaMap]:
    """Return the gain over the sphere of every antenna, by ``(tower.channel, "uav" or "tower")``."""
    vectors = learned.sphere_grid()[2]
    flat, shape = vectors.reshape(-1, 3), vectors.shape[:2]
    fit, out = calibration.fit, {}
    for antenna in fit.antennas:
        ends: tuple[tuple[str, Frame, str], ...] = (("uav", "body", "uav"), ("tower", "mast", antenna))
        for end, frame, name in ends:
            gain, sd = fit.gain(frame, antenna, flat)
            raw = (gain + calibration.learned.pattern_db(name, flat)).reshape(shape)
            gain_dbi = learned.unit_mean_gain(raw)
            out[antenna, end] = AntennaMap(
                name=f"{antenna} {end}",
                directions=vectors,
                gain_dbi=gain_dbi,
                sd_db=sd.reshape(shape),
                level_db=float((raw - gain_dbi).flat[0]),
                flown=fit.seen(frame, antenna),
            )
    return out


def _antenna_files(
    calibration: Calibration, maps: Mapping[tuple[str, str], AntennaMap], carrier_hz: float
) -> dict[str, str]:
    """Return the antenna files by name: the full sphere with standard deviation, and cuts for planning tools.

    Parameters
    ----------
    calibration : Calibration
    maps : mapping of (antenna, end) to AntennaMap
    carrier_hz : float

    Returns
    -------
    dict of str to str
    """
    names = ", ".join(calibration.names)
    notes = (
        f"aerpaw-cmp calibrate: {calibration.settings.calibration}, from {names}",
        "gain of the antenna as mounted: UAV in the body frame (x forward, y left, z up), tower in east-north-up",
        "azimuth counter-clockwise from x; level normalised to a mean of 0 dBi; gain_sd_db: standard deviation",
    )
    out: dict[str, str] = {}
    for (antenna, end), gains in maps.items():
        stem = safe_name(f"{antenna}.{end}")
        out[f"{stem}.csv"] = learned.sphere_csv(gains.gain_dbi, gains.sd_db, (*notes, *_provenance_notes(calibration)))
        pair = _pair_gain(calibration, antenna) if end == "tower" else None
        if pair is not None:
            out[f"{safe_name(f'{antenna}.pair')}.csv"] = pair.table((*notes[:1], *_provenance_notes(calibration)))
        pattern = learned.SpherePattern(stem, gains.gain_dbi, gains.sd_db)
        out[f"{stem}.msi"] = learned.planning_cuts(pattern, stem, carrier_hz, _provenance_notes(calibration))
    return out


def _provenance_notes(calibration: Calibration) -> Sequence[str]:
    """Return the notes about training logs, which are the same in all antenna files."""
    return f"{KEY}: {' '.join(calibration.trained_on)}", f"{MARKS}: {' '.join(calibration.marks)}"


def _pair_gain(calibration: Calibration, antenna: str) -> learned.PairGain | None:
    """Return the joint gain of an antenna and the UAV, or None if it was not learned."""
    fit = calibration.fit
    if (term := calibration.pair_term) is None:
        return None
    flown, length = fit.seen("pair", antenna), term.length
    at = flown[determining(flown, lambda a, b: gaussian_kernel(a, b, length), _PAIR_SHARE, _MOST_PAIRS)]
    return learned.PairGain(
        directions=at,
        gain_db=fit.gain("pair", antenna, at)[0],
        sd_db=fit.predict(directed(antenna, at), ("body", "mast", "pair"))[1],
        length=term.length,
        prior_sd_db=term.sd_db,
    )


def _learned_antenna(
    calibration: Calibration, antenna: str, end: str, files: Mapping[str, str], place: str, command: str
) -> dict[str, Any]:
    """Return the array of one end for calibrated.yaml: the table of the gain, with SHA-256 and error model."""

    def sha256(file: str) -> str:
        return hashlib.sha256(files[file].encode()).hexdigest()

    file, pair_file = (safe_name(f"{antenna}.{part}") + ".csv" for part in (end, "pair"))
    pair, spread = calibration.pair_term if end == "tower" else None, calibration.learned.spread(antenna)
    both = None if pair is None else learned.LearnedPair(
        file=f"{place}/{pair_file}", sha256=sha256(pair_file), length=pair.length, prior_sd_db=_rounded(pair.sd_db)
    )  # fmt: skip
    known = learned.LearnedAntenna(sha256=sha256(file), command=command, pair=both, spread=rounded_spread(spread))
    content = known.model_dump(exclude_none=True)
    return {"antenna": {"model": "sphere", "file": f"{place}/{file}", "learned": content}}


def rounded_spread(spread: Spread) -> learned.LearnedSpread:
    """Return an error model rounded to four digits, as it is written to files."""
    return learned.LearnedSpread(**{name: _rounded(value) for name, value in dataclasses.asdict(spread).items()})


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def learned_settings(
    calibration: Calibration, folder_name: str, files: Mapping[str, str], command: str
) -> dict[str, Any]:
    """Return the part of a flight.yaml that names the learned antennas, for calibrated.yaml.

    Parameters
    ----------
    calibration : Calibration
    folder_name : str
        Folder of the antenna files.
    files : mapping of str to str
        Content of the antenna files by name.
    command : str
        Command that creates the files.

    Returns
    -------
    dict
        Content of the file.
    """
    channels: dict[str, dict[str, Any]] = {}
    towers = [antenna.partition(".")[::2] for antenna in calibration.fit.antennas]
    for antenna, (tower, channel) in zip(calibration.fit.antennas, towers, strict=True):
        link = calibration.first_series(antenna)[1].link
        at_uav, at_tower = (
            _learned_antenna(calibration, antenna, e, files, folder_name, command) for e in ("uav", "tower")
        )
        power_dbm = link.transmit_power_dbm
        entry = channels.setdefault(channel, {"carrier_hz": link.carrier_hz, "transmit_power_dbm": power_dbm})
        entry["uav"] = at_uav
        # if only one tower has a channel, its antenna is also used at other towers
        if [name for _, name in towers].count(channel) == 1:
            entry["tower"] = at_tower
        else:
            entry.setdefault("towers", {})[tower] = at_tower
    # the gains were learned with the direct path only, so replay the direct path only
    return {"link": {"channels": channels}, "rt": {"engine": "image", "attitude": "logged", "max_depth": 0}}


def _record_of(
    calibration: Calibration, maps: Mapping[tuple[str, str], AntennaMap], text: str, stages_s: Mapping[str, float]
) -> CalibrationData:
    """Return the record from which the page is written.

    Parameters
    ----------
    calibration : Calibration
    maps : mapping of (antenna, end) to AntennaMap
    text : str
        The settings to copy into a flight file.
    stages_s : mapping of str to float
        Time of each stage [s].

    Returns
    -------
    CalibrationData
        Input of :func:`aerpaw_cmp.report.calibration.write_calibration`.
    """
    mounts = {
        name: {k: v for k, v in dataclasses.asdict(m).items() if k not in ("grid_deg", "probability")}
        | {"probability": dict(zip([f"{g:g}" for g in m.grid_deg], map(float, m.probability), strict=True))}
        for name, m in calibration.learned.mounts.items()
    }
    model = dataclasses.asdict(calibration.learned.model)
    model["campaigns"] = model.pop("own_scales_db")  # the key in metrics.json, which scripts read
    return CalibrationData(
        name=calibration.settings.calibration,
        flights=calibration.names,
        trained_on=calibration.trained_on,
        marks=calibration.marks,
        words=calibration.words,
        warnings=calibration.warnings,
        scores={k: [dataclasses.asdict(s) for s in v] for k, v in calibration.scores.items()},
        controls={k: [dataclasses.asdict(s) for s in v] for k, v in calibration.controls.items()},
        mounts=mounts,
        strengths={"model": model},
        antennas=tuple(maps.values()),
        settings_text=text,
        stages_s=stages_s,
    )


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The results of a calibration, with remarks on the logs of its flights."""

    settings: CalibrationFile
    flights: tuple[FlightData, ...]
    remarks: tuple[str, ...]
    calibration: Calibration | None
    ranked: RankCalibration | None
    command: str
    campaigns: Mapping[str, str]


def write_files(
    calibrated: Calibrated, folder: Path, name: str, stages_s: Mapping[str, float]
) -> tuple[dict[str, Any], str]:
    """Write the files of a calibration, and return its metrics and the text of calibrated.yaml.

    Parameters
    ----------
    calibrated : Calibrated
    folder : Path
        Existing folder to write to. The caller then moves it to its final place.
    name : str
        Name of the final folder, which is used in the paths of calibrated.yaml.
    stages_s : mapping of str to float
        Time of each stage [s].

    Returns
    -------
    metrics : dict
    text : str
        calibrated.yaml.
    """
    calibration, ranked = calibrated.calibration, calibrated.ranked
    rank, rank_warnings = (None, ()) if ranked is None else (ranked.metrics(), ranked.warnings)
    logs, marks = union(*map(flight_logs, calibrated.flights)), marks_of(calibrated.flights)
    head = [f"{_MARK}: {calibrated.settings.calibration}"]
    content: dict[str, Any] = {KEY: list(logs)}
    if calibration is not None:
        maps = _antenna_maps(calibration)
        carrier = next(s.link.carrier_hz for data in calibrated.flights for s in data.rss)
        files = _antenna_files(calibration, maps, carrier)
        for file, table in files.items():
            write_file(folder / file, table)
        head[0] += f". Learned from {', '.join(calibration.names)}."
        head += [f"# {text}" for text in calibration.words]
        head.append("# Put this into a flight.yaml. Files resolve against its folder, or --logs-root.")
        content |= learned_settings(calibration, name, files, calibrated.command)
        record = dataclasses.replace(
            _record_of(calibration, maps, dump_yaml(content), stages_s),
            rank=rank,
            warnings=(*calibrated.remarks, *calibration.warnings, *rank_warnings),
        )
        write_calibration(record, folder)
        metrics = calibration_metrics(record)
    else:
        metrics = {
            "scores": {}, "controls": {}, "words": [], "antennas": [], "calibration": calibrated.settings.calibration,
            "rank": rank, "warnings": [*calibrated.remarks, *rank_warnings], "flights": calibrated.settings.flights,
            KEY: list(logs), MARKS: list(marks),
        }  # fmt: skip
        (folder / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n", encoding="utf-8")
    if ranked is not None:
        (folder / "receiver.json").write_text(ranked.text(), encoding="utf-8")
        content["rank"] = {"receiver": f"{name}/receiver.json"}
    return metrics, "".join(f"{line}\n" for line in head) + dump_yaml({**content, MARKS: list(marks)})


def site_entries(calibrated: Calibrated) -> dict[str, tuple[learned.Entry, dict[str, bytes]]]:
    """Return the entries for the learned models of a site, each with its tables by name, by campaign."""
    settings, out = calibrated.settings, {}
    maps = None if calibrated.calibration is None else _antenna_maps(calibrated.calibration)
    for name, campaign in settings.by_campaign().items():
        flights = [f for f in calibrated.flights if calibrated.campaigns[f.settings.flight.name] == name]
        begins = [s.time.min() for data in flights for _, s in data.series]
        made = learned.Entry(
            command=calibrated.command,
            made=datetime.now(timezone.utc).date().isoformat(),
            flights=[data.settings.flight.name for data in flights],
            flown=sorted({str(begin.astype("datetime64[D]")) for begin in begins if has_wall_clock(begin)}),
            joined=[other for other in settings.by_campaign() if other != name],
            trained_on=list(union(*map(flight_logs, calibrated.flights))),
            source=campaign.source,
        )
        tables: dict[str, bytes] = {}
        if calibrated.calibration is not None and maps is not None:
            series, tables = _learned_series(calibrated.calibration, name, maps)
            errors = _errors(calibrated.calibration, name)
            made = made.model_copy(update={"errors": errors, "series": series})
        if calibrated.ranked is not None:
            file = f"{safe_name(name)}.receiver.json.gz"
            made = made.model_copy(update={"receivers": _learned_receivers(flights, calibrated.ranked, file)})
            tables = {**tables, file: calibrated.ranked.text().encode()}
        out[name] = made, tables
    return out


def _learned_series(
    calibration: Calibration, name: str, maps: Mapping[tuple[str, str], AntennaMap]
) -> tuple[list[learned.LearnedSeries], dict[str, bytes]]:
    """Return the antennas of all towers and channels of a campaign, and their tables by name."""
    tables: dict[str, bytes] = {}
    series = []
    mine = [o.samples for o in calibration.observed if calibration.campaigns[o.samples.flight] == name]
    for antenna in (a for a in calibration.fit.antennas if any(s.antenna == a for s in mine)):
        samples = [s for s in mine if s.antenna == antenna]
        # the UAV has the same antenna for all towers of a band, so one table is enough
        shared = next(s.antenna for s in mine if s.airframe == samples[0].airframe)
        parts = {"tower": antenna, "pair": antenna, "tower_known": antenna, "uav": shared, "known": shared}
        files = {part: f"{safe_name(f'{name}.{owner}.{part}')}.csv.gz" for part, owner in parts.items()}
        notes = {p: (f"aerpaw-cmp calibrate: {name}, {antenna} {p}", *_provenance_notes(calibration)) for p in files}
        # omit fingerprints, which would be most of the size of these tables. Flight files never name the tables.
        notes |= {part: notes[part][:2] for part in ("known", "tower_known", "pair")}
        for end in ("tower", "uav"):
            gains = maps[parts[end], end]
            content = learned.sphere_csv(gains.gain_dbi, gains.sd_db, notes[end], decimals=2)
            tables.setdefault(files[end], content.encode())
        if files["known"] not in tables:
            tables[files["known"]] = direction_covariance(calibration.fit, antenna).table(notes["known"]).encode()
        known = direction_covariance(calibration.fit, antenna, "mast")
        tables[files["tower_known"]] = known.table(notes["tower_known"]).encode()
        both = None
        if (pair := _pair_gain(calibration, antenna)) is not None:
            tables[files["pair"]] = pair.table(notes["pair"]).encode()
            both = learned.LearnedPair(file=files["pair"], length=pair.length, prior_sd_db=_rounded(pair.prior_sd_db))
        (data, first), ends = calibration.first_series(antenna), (maps[shared, "uav"], maps[antenna, "tower"])
        sds = np.concatenate([calibration.learned.predict(s.part(spread_out(len(s), _SD_SAMPLES)))[1] for s in samples])
        series.append(
            learned.LearnedSeries(
                tower=samples[0].tower,
                channel=samples[0].channel,
                receiver=data.settings.logs[int(first.log[0])].receiver,
                carrier_hz=first.link.carrier_hz,
                tower_file=files["tower"],
                uav_file=files["uav"],
                known_file=files["known"],
                tower_known_file=files["tower_known"],
                pair=both,
                spread=rounded_spread(calibration.learned.spread(antenna)),
                sd_db=round(float(np.nanmean(sds)), 2),
                shares_airframe=name in calibration.teaching,
                lock=_at_unit_gain(calibration.locks.get(antenna), *ends),
                level=_level(calibration, first, *ends),
                health=calibration.health.get(antenna),
            )
        )
    return series, tables


# Number of samples from which the mean standard deviation of a series is computed.
_SD_SAMPLES = 200


def _level(calibration: Calibration, series: RssSeries, *ends: AntennaMap) -> learned.LearnedLevel | None:
    """Return the mean level of the flights relative to the written antennas, with its error on held-out flights."""
    mine = [o for o in calibration.observed if (o.samples.tower, o.samples.channel) == (series.tower, series.channel)]
    if mine[0].samples.antenna in calibration.locks:  # without lock, levels do not depend on the path
        mine = [o.part(o.locked == 1.0) for o in mine if o.locked is not None]
    sent = series.link.transmit_power_dbm
    offsets = [calibration.learned.mean_error(o.samples) + o.sent_dbm - sent for o in mine]
    squares = [
        max(s.rmse_shared_offset_db**2 - s.rmse_db**2, 0.0)
        for s in calibration.scores["flight_left_out"]
        if (s.tower, s.channel) == (series.tower, series.channel)
    ]
    n = max(len(squares), 1)
    # the difference from the mean of all n flights is (n - 1) / n times that from the mean of the other n - 1 flights
    between_db = offset_sd_db((1.0 - 1.0 / n) ** 2 * sum(squares), n - 1)
    return learned.LearnedLevel(
        offset_db=round(float(np.nanmean(offsets)) + sum(end.level_db for end in ends), 2),
        sd_db=round(math.sqrt(1.0 + 1.0 / n) * between_db, 2),
        transmit_power_dbm=sent,
        unit=series.unit,
    )


def _at_unit_gain(lock: learned.LearnedLock | None, *ends: AntennaMap) -> learned.LearnedLock | None:
    """Return the lock model for levels predicted with the written antennas."""
    if lock is None:
        return None
    return lock.model_copy(update={"gain_db": round(lock.gain_db - sum(end.level_db for end in ends), 2)})


def _learned_receivers(
    flights: Sequence[FlightData], ranked: RankCalibration, file: str
) -> list[learned.LearnedReceiver]:
    """Return the fitted receivers with their scores on held-out flights."""
    receivers = []
    for tower in ranked.receivers:
        scores = [score for _, at, score in ranked.scores["flight_left_out"] if at == tower]
        first = next((data, s) for data in flights for s in data.rank if s.tower == tower)
        means = {
            key: round(float(np.mean([getattr(item, key) for item in scores])), 3)
            for key in ("kappa", "log_score", "constant_log_score")
            if scores
        }
        link = first[0].settings.link.rank
        receivers.append(
            learned.LearnedReceiver(
                tower=tower, quantity=quantity_of(*first), carrier_hz=link.carrier_hz, file=file, **means
            )
        )
    return receivers


def _errors(calibration: Calibration, name: str) -> learned.Errors | None:
    """Return the errors on held-out flights and held-out parts of a campaign, or None without held-out flights."""

    def mine(split: str) -> list[Score]:
        return [s for s in calibration.scores[split] if calibration.campaigns[s.flight] == name]

    scores = mine("flight_left_out")
    if not scores:
        return None
    values = {
        key: round(mean_rmse(scores, key), 3) for key in ("rmse_db", "rmse_4s_db", "free_space_rmse_db", "inside_90")
    }
    parts = {key: mine(f"{split}_left_out") for key, split in _PARTS.items()}
    values |= {f"{key}_rmse_db": round(mean_rmse(some), 3) for key, some in parts.items() if some}
    heights = {cruise_height_m(o) for o in calibration.observed if calibration.campaigns[o.samples.flight] == name}
    return learned.Errors(series=len(scores), heights_m=sorted(heights), **values)


# Name of the split for the prefix of each error. For "airframe", only the airframe of other campaigns is used.
_PARTS = {"sector": "sector", "height": "altitude", "heading": "heading", "airframe": "campaign"}
