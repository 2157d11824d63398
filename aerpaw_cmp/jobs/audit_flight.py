"""Audit of a flight's replays: paths by the other engine, fields by Sionna and by a second implementation.

The inputs of the second implementation come from the settings, not from the arrays and losses of the replay. An error
in the code between the settings and the replay is therefore detected.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.content import content_digest
from ..common.files import cache_folder
from ..common.stages import Progress, logged
from ..common.text import counted
from ..common.units import AnyArray, FloatArray, spread_out
from ..common.versions import code_digest, library_versions, utc_now
from ..compare.level import FieldAudit
from ..compare.result import AuditResult, EngineResult
from ..flight.data import FlightData
from ..flight.gains import LOSSES, path_loss
from ..flight.replay import Replayed, attitude_rotation, part_of
from ..flight.settings import ArraySettings, LinkSettings, RtSettings, load_pattern
from ..logs.ingest import IngestedFile
from ..propagation.check import reference
from ..propagation.check.audit import REFERENCE_LINKS, Audit, Expected, Second, audit, scalar_pattern
from ..propagation.drivers import site_with_tower_at
from ..propagation.llvm import SionnaMissingError
from ..propagation.options import Field, Search
from ..propagation.replay import PER_LINK
from ..propagation.search.sionna import free_memory
from ..site.site import Site
from .tasks import OutcomeStore

# Number of logged attitudes that are converted to rotations a second time.
_ATTITUDE_ROWS = 200

# Largest difference of both rotations: they are float64, and telemetry times are exact to a nanosecond.
_ATTITUDE_TOLERANCE_RAD = 1e-6

# Largest number of links of all series together, but at least three per series. A link takes about 0.1 s.
_REFERENCE_LINKS_AT_MOST = 64

_TIMES = "Time: the part of the replay for the audited links. Time of the reference: including its start."

# Errors that an audit of the replay cannot detect.
_NOT_COVERED = (
    "whether the ground and walls of the site reflect like smooth half-spaces",
    "positions of footprints and trees; intervals",
    "terrain that blocks",
)


def audit_replays(
    data: FlightData, replays: Sequence[Replayed], progress: Progress = logged, *, fresh: bool = True
) -> EngineResult:
    """Return the engine record, with an audit if ``rt.audit_links`` is above 0.

    Parameters
    ----------
    data : FlightData
    replays : sequence of Replayed
        Replays of the RSS series of the flight, then of its rank series.
    progress : Progress
    fresh : bool
        True to ignore the cached audit.

    Returns
    -------
    EngineResult
    """
    rt, checked, not_audited = data.settings.rt, None, ""
    if rt.audit_links:
        try:
            checked = _audit_or_read(data, replays, progress, fresh=fresh)
        except SionnaMissingError as error:  # all other numbers are the same without Sionna
            if rt.engine == "sionna":
                raise
            not_audited = str(error)
    return EngineResult(
        engine=rt.engine,
        links=sum(len(r.poses) for r in replays),
        seconds=sum(r.replay.seconds for r in replays),
        paths=sum(len(r.replay.paths) for r in replays),
        settings={
            "max_depth": rt.max_depth,
            "attitude": data.settings.rss_attitude if data.rss else rt.attitude,
            "foliage": rt.foliage,
            "samples": max((r.replay.samples for r in replays), default=0) or rt.advanced.samples,
        },
        left_out=tuple(dict.fromkeys(text for r in replays for text in r.replay.left_out)),
        audit=checked,
        not_audited=not_audited,
    )


def _audit_or_read(
    data: FlightData, replays: Sequence[Replayed], progress: Progress, *, fresh: bool
) -> AuditResult | None:
    """Return the audit from the cache, else compute it. ``fresh`` ignores the cache."""
    store, key = OutcomeStore(cache_folder("audits"), AuditResult), _content_of(data, replays)
    known: AuditResult | None = None if fresh else store.load(key)
    if known is None and (made := _audit(data, replays, progress)) is not None:
        store.save(key, dataclasses.replace(made, read_from_cache_of=utc_now()[:10]))
        return made
    return known


# Keys of flight.yaml that an audit reads.
_SETTINGS = {"rt", "link", "rank", "antennas", "towers"}


def _content_of(data: FlightData, replays: Sequence[Replayed]) -> str:
    """Return the SHA-256 of all inputs of an audit: libraries, code, site, logs, settings and replays."""
    settings = data.settings.model_dump(mode="json", include=_SETTINGS), data.settings.rank_rt.model_dump(mode="json")
    seen = [
        (r.poses, r.tower_m, *(getattr(r.replay, name) for name in ("towers", "faces", "contributions", *PER_LINK)))
        for r in replays
    ]
    logs = [file.sha256 for file in data.files]
    return content_digest(library_versions(), code_digest(), settings, data.site, logs, seen)


def _audit(data: FlightData, replays: Sequence[Replayed], progress: Progress) -> AuditResult | None:
    """Audit all series, with links in proportion to their poses."""
    ks, audit_links = data.settings.rank.k, data.settings.rt.audit_links
    total = sum(len(r.poses) for r in replays)
    few = int(np.clip(_REFERENCE_LINKS_AT_MOST // max(len(replays), 1), 3, REFERENCE_LINKS))
    parts: list[Audit] = []
    known: dict[str, Any] = {}
    for site, replayed, expected, rt in standing(data, replays):
        count = len(replayed.poses)
        links = min(count, max(math.ceil(audit_links * count / max(total, 1)), 1))
        if links:
            progress(f"audit {replayed.replay.towers[0]}: {counted(links, 'link')}")
            second = Second(links=links, expected=expected, ks=ks, reference_links=few, known=known)
            field = Field(loss=path_loss(site, rt, replayed.link.carrier_hz))
            search = Search(max_depth=rt.max_depth, samples=rt.advanced.samples)
            parts.append(audit(site, replayed.link, replayed.poses, replayed.replay, search, field, second=second))
    if not parts:
        return None
    free_memory()
    errors = [p.rss_max_error_db for p in parts if np.isfinite(p.rss_max_error_db)]
    links, rays = sum(p.links for p in parts), max(parts, key=lambda p: p.samples).samples_reason
    fields = sum((p.field for p in parts if p.field is not None), attitude_checked(data, replays))
    return AuditResult(
        reference=parts[0].reference,
        links=links,
        missing_paths=sum(p.missing_paths for p in parts),
        extra_paths=sum(p.extra_paths for p in parts),
        rss_max_error_db=max(errors, default=float("nan")),
        rank_disagreement={k: sum(p.rank_disagreement[k] * p.links for p in parts) / links for k in ks},
        seconds=sum(r.replay.seconds for r in replays) * links / max(total, 1),
        reference_seconds=sum(p.reference_seconds for p in parts),
        note=_TIMES + (f" The number of rays was raised until two trial runs agreed: {rays}." if rays else ""),
        fields=dataclasses.replace(fields, not_covered=(*fields.not_covered, *_NOT_COVERED)),
    )


# A moving tower is audited at this number of times, each time as a fixed tower in a separate scene.
_MOMENTS = 6


def standing(data: FlightData, replays: Sequence[Replayed]) -> Iterator[tuple[Site, Replayed, Expected, RtSettings]]:
    """Yield replays, expected inputs and settings. A moving tower is replaced by fixed towers at several times."""
    of_each = _settings_of(data)[: len(replays)]
    for replayed, expected, rt in zip(replays, expectations(data, replays), of_each, strict=True):
        site = data.site.under(rt.foliage)
        if replayed.tower_m is None:
            yield site, replayed, expected, rt
            continue
        (tower,) = replayed.link.tower_arrays
        count = len(replayed.poses)
        for at in spread_out(count, _MOMENTS).tolist():
            pose = replayed.poses[at : at + 1]
            moment = dataclasses.replace(
                replayed,
                poses=pose,
                valid=np.ones(1, dtype=np.bool_),
                replay=part_of(replayed.replay, at, at + 1),
                track=None,
                tower_m=None,
            )
            yield site_with_tower_at(site, tower, replayed.tower_m[at]), moment, expected, rt


# --- expected inputs -----------------------------------------------------------------------------------------------


def expectations(data: FlightData, replays: Sequence[Replayed]) -> list[Expected]:
    """Return the link and losses of each replay, from the settings."""
    settings = [*(s.link for s in data.rss), *[data.settings.link.rank] * len(data.rank)]
    losses = [
        reference.ExpectedLoss(**{key: value for each in LOSSES for key, value in each.expected(rt).items()})
        for rt in _settings_of(data)
    ]
    if len(settings) != len(replays):  # only some series were replayed: use the links of the replays
        return [Expected.of(r.link, losses[0]) for r in replays]
    return [
        Expected(expected_link(link, list(r.link.tower_arrays), data.folder), loss)
        for link, r, loss in zip(settings, replays, losses, strict=True)
    ]


def _settings_of(data: FlightData) -> list[RtSettings]:
    """Return the settings of each replay, first of the levels, then of the ranks."""
    return [data.settings.rt] * len(data.rss) + [data.settings.rank_rt] * len(data.rank)


def expected_link(settings: LinkSettings, towers: Sequence[str], folder: Path) -> reference.ExpectedLink:
    """Return the expected link of flight.yaml."""
    wavelength = reference.C_MPS / settings.carrier_hz
    return reference.ExpectedLink(
        carrier_hz=settings.carrier_hz,
        transmit_power_dbm=settings.transmit_power_dbm,
        uav_transmits=settings.uav_transmits,
        towers={name: expected_array(settings.towers.get(name, settings.tower), wavelength, folder) for name in towers},
        uav=expected_array(settings.uav, wavelength, folder),
        # k T B at 290 K
        noise_floor_dbm=10 * math.log10(1.380649e-23 * 290 * (settings.bandwidth_hz or 1.0) * 1e3)
        + (settings.noise_figure_db or 0.0),
    )


def expected_array(settings: ArraySettings, wavelength: float, folder: Path) -> reference.ExpectedArray:
    """Return the expected array of flight.yaml, computed a second time."""
    elements = settings.elements or 4  # default of layout linear
    positions = reference.layout_positions(settings.layout, wavelength, elements, settings.positions_m)
    slants = settings.slant_deg if isinstance(settings.slant_deg, list) else [settings.slant_deg]
    pattern = scalar_pattern(load_pattern(settings.antenna, folder, reference.C_MPS / wavelength))
    return reference.ExpectedArray(
        positions_m=positions,
        slants_deg=tuple(slants * len(positions) if len(slants) == 1 else slants),
        patterns=(pattern,) * len(positions),
        mount=reference.turned(settings.yaw_deg, settings.pitch_deg, settings.roll_deg),
    )


# --- attitude --------------------------------------------------------------------------------------------------------


def attitude_checked(data: FlightData, replays: Sequence[Replayed]) -> FieldAudit:
    """Compare rotations of the track at telemetry times with rotations computed from the logged angles."""
    mode = data.settings.rss_attitude
    if mode == "ignored" or data.track is None:
        turned_anyway = any(np.abs(r.poses.rotation - np.eye(3)).max(initial=0.0) > 0 for r in replays)
        moved = mode == "ignored" and turned_anyway
        return FieldAudit(failures=("rt.attitude is 'ignored' but the UAV's array turns",) if moved else ())
    times, angles = _logged_attitudes(data.files)
    if not len(times):
        return FieldAudit(not_covered=("the attitude, because the telemetry has none",))
    rows = spread_out(len(times), _ATTITUDE_ROWS)
    at = data.track.pose_at(times[rows])
    used = np.flatnonzero(at.valid & at.attitude_known)
    rotation = attitude_rotation(at, mode)
    worst = 0.0
    for index in used:
        roll, pitch, yaw = (float(x) for x in angles[rows[index]])
        expected = np.array(reference.aircraft(*((roll, pitch) if mode == "logged" else (0.0, 0.0)), yaw))
        worst = max(worst, float(np.abs(expected - rotation[index]).max()))
    wrong = worst > _ATTITUDE_TOLERANCE_RAD
    failures = (f"rotations differ from the logged attitude by {worst:.2g} rad",) if wrong else ()
    return FieldAudit(attitude_rows=len(used), attitude_max_rad=worst, failures=failures)


def _logged_attitudes(files: Sequence[IngestedFile]) -> tuple[AnyArray, FloatArray]:
    """Return times (n,) and roll, pitch, yaw (n, 3) [deg] of telemetry rows with a unique time."""
    import pandas as pd

    frames = [s.frame for f in files for s in f.result.streams if s.kind == "telemetry"]
    if not frames:
        return np.zeros(0, dtype="datetime64[ns]"), np.zeros((0, 3))
    frame = frames[0]
    frame = frame[pd.notna(frame["time"]) & ~frame["time"].duplicated(keep=False)]
    angles = frame[["roll_deg", "pitch_deg", "yaw_deg"]].to_numpy(dtype=np.float64)
    good = np.isfinite(angles).all(axis=1)
    return np.asarray(frame["time"].to_numpy())[good], angles[good]
