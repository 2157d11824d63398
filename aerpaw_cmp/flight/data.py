"""The data of one flight from a checked flight file: site, logs, track, RSS and rank series.

Settings that have no effect are reported, because they mislead the reader of a report. A value that equals its default
is not reported. Towers and channels that the flight does not have are refused (:func:`check_names`).
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import BaseModel

from ..common.errors import InputError, UsageError
from ..common.grouping import lists_by_key
from ..common.text import counted
from ..common.units import MINIMUM_HEIGHT_M, AnyArray, BoolArray, FloatArray, IntArray
from ..common.yamlfile import nearest
from ..logs.ingest import ROLLOVER_DAYS, Held, IngestedFile, ingest, named_log, read_log
from ..logs.records import COLUMNS, Stream
from ..propagation.geometry import Link
from ..site.learned import read_learned
from ..site.site import Site, Tower
from ..site.siteyaml import load_site, misread
from .clock import clock_trap
from .cross_checks import check_heights, doubts
from .rows import FLAG, frozen, lock_of, scored_rows, unscored, without_values
from .settings import FlightFile, GroundNode, LinkSettings, LinksSettings, LogSettings, RankSettings, SiteChoice
from .track import Track, TrackPoses, at_height, good_positions, lacks_height, raised

# A log with relative times starts at its origin. If a log starts later than this after the origin, its times are
# absolute.
_NEAR_ORIGIN = pd.Timedelta(days=2)


def idle_log_keys(log: LogSettings, file: IngestedFile) -> list[str]:
    """Return warnings about keys without effect in an entry of ``logs:``, one warning per reason."""
    streams = file.result.streams
    kinds = {stream.kind for stream in streams}
    keys: dict[str, list[str]] = {}
    if "rss" not in kinds:
        keys["it has no levels"] = ["channel", "frequency_hz", "unit", "floor_db", "cells"]
    elif not any(stream.attributes.get("pci") in log.cells or stream.name in log.cells for stream in streams):
        keys["it has none of these cells"] = ["cells"]
    if not kinds & {"rss", "rank"}:
        keys["it has neither levels nor ranks"] = ["node"]
    if file.result.reader != "generic_csv":
        keys[f"the reader {file.result.reader} finds its columns itself"] = ["columns", "kind"]
    bases = {str(stream.attributes["ri_base"]) for stream in streams if "ri_base" in stream.attributes}
    if log.ri_base is not None and log.ri_base not in bases:
        keys[f"the log counts from {' and '.join(bases)}" if bases else "it has no ranks"] = ["ri_base"]
    if log.time_origin is not None and not _starts_near(log.time_origin, file):
        keys["its times are absolute"] = ["time_origin"]
    return _without_effect(log, keys.items())


def _starts_near(origin: str, file: IngestedFile) -> bool:
    # an unreadable origin becomes NaT, which is not near any time
    zero = pd.to_datetime(origin, errors="coerce", utc=True).tz_localize(None)
    times = [s.frame["time"].min() for s in file.result.streams if len(s.frame) and "time" in s.frame]
    return not times or bool(np.min([abs(time - zero) for time in times]) < _NEAR_ORIGIN)


def _without_effect(model: BaseModel, reasons: Iterable[tuple[str, Sequence[str]]]) -> list[str]:
    """Return a sentence per reason about the dotted keys that the user changed."""
    changed = ((why, [key for key in keys if _differs(model, key)]) for why, keys in reasons)
    return [
        f"{', '.join(keys)} {'has' if len(keys) == 1 else 'have'} no effect: {why}" for why, keys in changed if keys
    ]


def _reasons(settings: FlightFile, kinds: Collection[str]) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield each reason, and the dotted keys without effect, for logs of these kinds ("rss", "rank")."""
    rt, lag = settings.rt, settings.rss.lag
    if rt.foliage != "attenuating":
        losses = ["rt.leaves", "rt.advanced.gamma_db_per_m", "rt.advanced.maximum_loss_db"]
        yield f"rt.foliage is {rt.foliage}", losses
    if rt.max_depth == 0:
        yield "rt.max_depth is 0, so nothing is reflected", ["rt.reflection_loss_db"]
    if rt.engine == "image" and rt.audit_links == 0:
        yield "rt.engine is image and rt.audit_links is 0, so no rays are shot", ["rt.advanced.samples"]
    if lag not in ("estimate", "apply"):
        yield f"rss.lag is {lag}, so no clock is estimated", ["rss.advanced.lag_window_s"]
    if "rss" not in kinds:
        yield "no log has levels", ["rss.span_db", "rss.lag", "rss.field", "rss.minimum_height_m"]
    if "rank" not in kinds:
        yield "no log has ranks", ["rank.receiver", "rank.minimum_height_m"]


def _differs(model: BaseModel, key: str) -> bool:
    """Check whether the value of a dotted key is not its default."""
    *above, name = key.split(".")
    part = reduce(getattr, above, model)
    return bool(getattr(part, name) != type(part).model_fields[name].get_default(call_default_factory=True))


Times = NDArray[np.datetime64]


@dataclass(frozen=True, slots=True)
class RssSeries:
    """The measured RSS of one tower and channel.

    ``time`` (n,) is in UTC. ``measured_db`` (n,) is NaN out of coverage.

    Parameters
    ----------
    settings_key : str
        A key that is equal for series with equal link settings, which share a replay.
    log : (n,) int
        Number of the log under ``logs:`` that contains each sample.
    line : (n,) int
        Line of each sample in that log.
    noise_dbm : float, optional
        Noise of the receiver for a signal-to-noise ratio, if its bandwidth or floor is known [dBm]. None for levels.
    flagged : mapping of str to int
        Numbers of rows of the log that are excluded because of a flag, by flag.
    serving : (n,), optional
        Serving state of a cell: 1 if it served the phone, 0 if another cell did, NaN unknown. None for other levels.
    locked : (n,), optional
        Receiver lock of a sounder: 1 in lock, 0 without lock, NaN unknown. None for other levels.
    """

    tower: str
    channel: str
    unit: str
    time: Times
    measured_db: FloatArray
    link: LinkSettings
    settings_key: str
    log: IntArray
    line: IntArray
    noise_dbm: float | None = None
    flagged: Mapping[str, int] = field(default_factory=dict)
    serving: FloatArray | None = None
    locked: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class RankSeries:
    """The reported rank at a tower: ``rank`` (n,), NaN without CSI, and ``position_m`` (n, 3) of the log or None.

    Parameters
    ----------
    flagged : mapping of str to int
        Numbers of rows of the log that are excluded because of a flag, by flag.
    """

    tower: str
    time: Times
    rank: FloatArray
    sinr_db: FloatArray
    position_m: FloatArray | None
    log: IntArray
    flagged: Mapping[str, int] = field(default_factory=dict)

    @property
    def channel(self) -> str:
        """The kind of the series, which is used as the name of its channel."""
        return "rank"


@dataclass(frozen=True, slots=True)
class FlightData:
    """The data of a flight before the replay.

    Parameters
    ----------
    folder : Path
        Folder of logs and antenna files: ``--logs-root``, or the folder of the flight file.
    site_place : str or Path
        Site file in the folder of the flight file, or the name of a packaged site.
    nodes : mapping of str to Track
        Tracks of the towers that move. ``site`` contains each of them at the median of its positions.
    doubts : tuple of str
        Clauses about clocks and heights that the summary of a report repeats.
    cautions : tuple of str
        Sentences about settings of the user that do not fit the flight. They come before all other warnings.
    kept_marks : list of str
        Fingerprints of the series, from :func:`.marks_of`. Empty until they are needed.
    """

    settings: FlightFile
    folder: Path
    site_place: str | Path
    site: Site
    files: tuple[IngestedFile, ...] = ()
    track: Track | None = None
    rss: tuple[RssSeries, ...] = ()
    rank: tuple[RankSeries, ...] = ()
    warnings: tuple[str, ...] = ()
    nodes: Mapping[str, Track] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    kept_marks: list[str] = field(init=False, default_factory=list, repr=False, compare=False)
    _links: dict[str, Link] = field(init=False, default_factory=dict, repr=False, compare=False)

    @property
    def series(self) -> list[tuple[str, RssSeries | RankSeries]]:
        """All series, each with its kind ("rss" or "rank"), RSS first."""
        return [*(("RSS", s) for s in self.rss), *(("rank", s) for s in self.rank)]

    def link_of(self, series: RssSeries | RankSeries) -> Link:
        """Return the link of a series to its tower. Antenna files are read once."""
        settings = series.link if isinstance(series, RssSeries) else self.settings.link.rank
        key = f"{series.tower} {series.settings_key if isinstance(series, RssSeries) else series.channel}"
        if key not in self._links:
            self._links[key] = settings.build([series.tower], self.folder)
        return self._links[key]

    def poses_at(self, time: Times) -> TrackPoses:
        """Return poses of the UAV at times (n,), for a flight with a track."""
        assert self.track is not None
        return self.track.pose_at(time)

    def tower_at(self, tower: str, time: Times) -> tuple[FloatArray, BoolArray]:
        """Return the array centre of a tower at times (n,), NaN if unknown, and a mask (n,) of the known positions.

        The shape is (1, 3) for a fixed tower, and (n, 3) for a tower that moves.
        """
        if tower not in self.nodes:
            return self.site.towers[tower].position_m[None, :], np.ones(len(time), dtype=np.bool_)
        pose = self.nodes[tower].pose_at(time)
        place = pose.position_m.copy()
        if self.settings.towers[tower].height == "ground":
            place[pose.valid, 2] = self.site.towers[tower].position_m[2]
        return place, pose.valid


def site_place(site: str, folder: Path) -> str | Path:
    """Return a site.yaml below the folder, or the name of a packaged site."""
    place = folder / site
    return place if place.suffix in (".yaml", ".yml") or place.is_file() else site


def choose_site(choice: SiteChoice, folder: Path) -> Site:
    """Return the site of a flight with the changes that the flight file specifies."""
    site = load_site(site_place(choice.file, folder), coordinates=choice.coordinates, tower_ground=choice.tower_ground)
    if choice.antenna_height_m is not None:
        towers = {
            key: dataclasses.replace(tower, antenna_height_m=choice.antenna_height_m)
            for key, tower in site.towers.items()
        }
        # the height applies to every tower, because a flight file does not list its towers
        site = dataclasses.replace(site, towers=towers)
    if choice.without_buildings:
        note = "this flight is replayed without the buildings of the site (site.without_buildings)"
        site = dataclasses.replace(site, buildings=(), notes=(*site.notes, note))
    return site


# A ground node is fixed if its positions stay within this distance of their median, because GNSS noise is that large.
STANDS_STILL_M = 3.0


def ground_nodes(
    site: Site, settings: FlightFile, folder: Path, warnings: list[str] | None = None
) -> tuple[Site, dict[str, Track]]:
    """Return the site with the nodes of the flight as towers, and the tracks of nodes that move.

    Parameters
    ----------
    site : Site
    settings : FlightFile
    folder : Path
        Folder of the logs of positions.
    warnings : list of str, optional
        Receives warnings about the tracks.

    Returns
    -------
    Site
        Site that contains a moving node at the median of its positions.
    dict of str to Track
        Tracks of the nodes that move, by name.

    Raises
    ------
    UsageError
        If the site already has a tower with this name.
    InputError
        If a track has no positions, or its times are unknown.
    """
    towers, nodes = dict(site.towers), dict[str, Track]()
    for name, node in settings.towers.items():
        if name in site.towers:
            raise UsageError(f"towers.{name}: site {site.name!r} has a tower of this name", expected="another name")
        if node.track is None:
            assert node.latitude_deg is not None
            assert node.longitude_deg is not None
            latitude, longitude, height_m = node.latitude_deg, node.longitude_deg, node.antenna_height_m
        else:
            (latitude, longitude, height_m), track, remarks = _tracked_node(name, node, folder, settings, site)
            nodes |= {} if track is None else {name: track}
            if warnings is not None:
                warnings += [f"towers.{name}: {text}" for text in remarks]
        if node.region90_m is not None and warnings is not None:
            warnings.append(
                f"towers.{name}: the position was chosen by the levels (90 % region: {node.region90_m:.0f} m), so a "
                "part of the error can be an error of this position: enter the measured position without region90_m"
            )
        east, north = site.frame.to_local(np.array([latitude]), np.array([longitude]))
        towers[name] = Tower(
            name=name,
            latitude_deg=latitude,
            longitude_deg=longitude,
            east_m=float(east[0]),
            north_m=float(north[0]),
            antenna_height_m=height_m,
            source="flight.yaml" if node.track is None else node.track.path,
        )
    return dataclasses.replace(site, towers=towers), nodes


def _tracked_node(
    name: str, node: GroundNode, folder: Path, settings: FlightFile, site: Site
) -> tuple[tuple[float, float, float], Track | None, Sequence[str]]:
    """Return the median position of a node (latitude, longitude, height), its track or None if fixed, and remarks.

    Latitude and longitude are in degrees, the height in metres.
    """
    assert node.track is not None
    path, logged = folder / node.track.path, node.height == "logged"
    frame = _node_positions(name, node.track, path, settings.timezone)
    places = frame[["latitude_deg", "longitude_deg"]].to_numpy(np.float64)
    # use the median, because a single position without a fix must not move the node
    middle = np.median(places, axis=0)
    east, north = site.frame.to_local(*np.vstack([middle, places]).T)
    reach_m = float(np.hypot(east - east[0], north - north[0]).max())
    # limit heights, because half of the GNSS heights of a node on the ground are below the ground
    up = np.maximum(frame["altitude_m"].to_numpy(np.float64) + site.takeoff_ground_m, MINIMUM_HEIGHT_M)
    if logged and not np.isfinite(up).any():
        raise InputError(
            "no heights in this log", expected=f"heights of towers.{name}, which has height: logged", path=path
        )
    height_m = float(np.nanmedian(up)) if logged else node.antenna_height_m
    at = float(middle[0]), float(middle[1]), height_m
    # the height of a node on the ground does not change
    if max(reach_m, float(np.nanmax(np.abs(up - height_m))) if logged else 0.0) <= STANDS_STILL_M:
        return at, None, ()
    # the logged heights of a node with ``height: ground`` are not used and may be missing
    track = _track_of(site, frame if logged else frame.assign(altitude_m=0.0), settings)
    if not len(track):
        raise InputError(
            f"towers.{name} moves and no position of its track has a time",
            expected="a time for each position",
            cause="relative times require 'time_origin' and local times 'timezone', next to the track's path",
            path=path,
        )
    remarks = [f"moves {reach_m:.0f} m from its median position: samples are replayed with its position at their times"]
    # the attitude of a node is not used, so its warnings are omitted
    return at, track, [*remarks, *dataclasses.replace(track.account, unknown_attitude=0, heading_alone=0).warnings]


def _track_of(site: Site, frame: pd.DataFrame, settings: FlightFile) -> Track:
    """Return the track of telemetry rows at a site."""
    gap_s, ground = settings.rt.advanced.maximum_gap_s, site.ground_under_m
    return Track(frame, site.frame, maximum_gap_s=gap_s, ground_m=site.takeoff_ground_m, ground=ground)


def _node_positions(name: str, log: LogSettings, path: Path, timezone: str | None) -> pd.DataFrame:
    """Return the rows of the first stream with positions, with all columns of telemetry."""
    if not path.is_file():
        raise InputError("there is no such log", expected=f"the positions of towers.{name}", path=path)
    options = log.options(timezone)
    (file,) = ingest([path], options=options, reader=log.reader_name)
    for stream in at_height(log, file).result.streams:
        if stream.name in log.skip or not {"latitude_deg", "longitude_deg"} <= set(stream.frame.columns):
            continue
        frame = stream.frame.loc[~unscored(stream.frame)]
        latitude, longitude = (frame[key].to_numpy(np.float64) for key in ("latitude_deg", "longitude_deg"))
        frame = frame.loc[good_positions(latitude, longitude, np.zeros(len(frame)))]
        if len(frame):
            records: pd.DataFrame = frame.reindex(columns=["time", *_TELEMETRY])
            return records
    raise InputError("no positions in this log", expected=f"positions of towers.{name}", path=path)


# All columns of telemetry except fix and number of satellites, which are not part of a pose.
_TELEMETRY = COLUMNS["telemetry"][:-2]


def read_logs(settings: FlightFile, folder: Path, logs_root: Path | None = None) -> tuple[IngestedFile, ...]:
    """Read every log of the flight file, in the order of the file.

    Raises
    ------
    InputError
        If a file is missing, a log has another kind than the flight file specifies, or a log has no record.
    """
    if not settings.logs:
        raise UsageError("the flight file lists no log", expected="one or more lines under 'logs:'")
    # an archive or file that contains several logs is read once
    root, cache = logs_root or folder, Held()
    for log in settings.logs:
        # report a missing log now, because reading the logs before it may take minutes
        named_log(root, log.path)
    # a table may have several lines, each of which reads some of its columns
    columns = {(log.path, name) for log in settings.logs for name in log.columns.values()}
    elsewhere = {log.path: {name for path, name in columns if path == log.path} for log in settings.logs}
    options = (
        dataclasses.replace(log.options(settings.timezone), read_elsewhere=elsewhere[log.path]) for log in settings.logs
    )
    return tuple(
        read_log(root, log.path, of_log, reader=log.reader_name, held=cache)
        for log, of_log in zip(settings.logs, options, strict=True)
    )


SNR = "snr"
# Names of streams or channels of kind rss that are ratios, from the sounder and the controller.
RATIOS = ("quality", SNR)


def is_ratio(stream: Stream, names: Sequence[str] = RATIOS) -> bool:
    """Check whether a stream of kind rss is a signal-to-noise ratio with one of the names."""
    known = (stream.name, _text(stream, "channel"), _text(stream, "quantity"))
    return stream.kind == "rss" and any(name is not None and name.lower() in names for name in known)


def is_own_radio(stream: Stream) -> bool:
    """Check whether a level comes from the autopilot's telemetry radio, which does not receive towers."""
    return stream.kind == "rss" and _text(stream, "quantity") == "telemetry radio RSSI"


def quantity_of(data: FlightData, series: RankSeries) -> str:
    """Return the name that a log specifies for its rank, or else the name of its reader."""
    result = data.files[int(series.log[0])].result
    return next(_text(stream, "source") or result.reader for stream in result.streams if stream.kind == "rank")


def _noise(stream: Stream, link: LinkSettings) -> tuple[float | None, LinkSettings]:
    """Return the noise power of an SNR [dBm] (None if the flight file does not specify it), and the link to use.

    An SNR estimator correlates with a known signal and also reports ratios below 0 dB, so the link has no noise floor.
    """
    if not is_ratio(stream, (SNR,)) or link.bandwidth_hz is None:
        return None, link
    return link.floor_dbm, link.model_copy(update={"bandwidth_hz": None, "noise_figure_db": None})


def unread(settings: FlightFile, folder: Path, logs_root: Path | None = None) -> FlightData:
    """Return the data of a flight without its logs: site, nodes, and remarks about the nodes.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Folder of the flight file.
    logs_root : Path, optional
        Folder of logs and antenna files, instead of ``folder``.
    """
    root, warnings = logs_root or folder, list[str]()
    site, nodes = ground_nodes(choose_site(settings.site, folder), settings, root, warnings)
    place = site_place(settings.site.file, folder)
    return FlightData(
        settings=settings, folder=root, site_place=place, site=site, nodes=nodes, warnings=tuple(warnings)
    )


def gather(
    settings: FlightFile, folder: Path, files: Sequence[IngestedFile], logs_root: Path | None = None
) -> FlightData:
    """Return the data of a flight: sort its streams into track, RSS and rank, and check that they belong together.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Folder of the flight file.
    files : sequence of IngestedFile
        Read logs in the order of ``settings.logs``.
    logs_root : Path, optional
        Folder of logs and antenna files, instead of ``folder``.

    Returns
    -------
    FlightData
        Site, track and series, with the warnings about the logs.

    Raises
    ------
    UsageError
        If a log does not specify its tower, the site does not have this tower, or two records have the same time.
    InputError
        If there is no position or no row to compare, or the flight is far from every tower.
    """
    files = [at_height(log, file) for log, file in zip(settings.logs, files, strict=True)]
    data = unread(settings, folder, logs_root)
    site, found = data.site, _Found(warnings=[*data.warnings])
    for number in range(len(files)):
        _sort_log(found, settings, site, files, number)
    rss, rank, warnings = found.rss, found.rank, found.warnings
    if found.void and not rss and not rank:
        raise found.void[0]
    warnings += _without_effect(settings, _reasons(settings, {*(["rss"] if rss else []), *(["rank"] if rank else [])}))
    if settings.rank.tower not in {RankSettings().tower, *(series.tower for _, series in rank)}:
        warnings.append("rank.tower has no effect: no log has ranks without its own 'node'")
    if rank and settings.link.rank.bandwidth_hz is None:
        warnings.append(
            "link.rank has no bandwidth_hz: ranks count as in coverage down to the thermal noise of 1 Hz (-174 dBm)"
        )
    cautions = check_names(settings, site, [(series.tower, series.channel) for _, series in rss])
    cautions += _unknown_receivers(settings, data.site_place)
    track = None
    if found.telemetry:
        path, telemetry = found.telemetry[0]
        if len(found.telemetry) > 1:
            warnings.append(f"{len(found.telemetry)} telemetry logs; the track is that of {path}")
        track = _flown_track(site, path, telemetry, settings)
        warnings += [f"{path}: {text}" for text in track.account.warnings]
        rss = [(place, _moving(place, series, track, warnings)) for place, series in rss]
    # if nothing has positions, keep the levels: the check of the overlap then reports the error with a better message
    elif rss and any(series.position_m is not None for _, series in rank):
        levels = ", ".join(dict.fromkeys(f"{series.tower} {series.channel}" for _, series in rss))
        warnings.append(f"no telemetry log: the levels of {levels} have no positions and are ignored")
        rss = []
    data = dataclasses.replace(
        data,
        files=tuple(files),
        track=track,
        rss=_records(rss, lambda s: f"RSS of {s.tower} {s.channel}"),
        rank=_records(rank, lambda s: f"rank of {s.tower}"),
    )
    for place, stream in (*found.telemetry[:1], *found.placed):
        check_place(site, place, stream.frame)
    _check_overlap(data)
    asked = tuple(site.cautions([series.tower for _, series in data.series]))
    if track is not None:
        asked += doubts(track, telemetry, _times_on_track(data), _undated(data, path), site.takeoff_ground_m)
        asked += check_heights(site, path, telemetry)
    # add the warnings after the check of the overlap, because a flight without common times has a separate message
    every = (*cautions, *_idle_attitude(data), *warnings, *(f"{text}." for text in asked))
    return dataclasses.replace(data, doubts=asked, warnings=every, cautions=cautions)


@dataclass(slots=True, kw_only=True)
class _Found:
    """Streams of the logs with their paths, grouped by use, and warnings.

    ``placed`` contains the ranks with their own positions, ``void`` the errors of series without any value.
    """

    warnings: list[str]
    telemetry: list[tuple[str, Stream]] = field(default_factory=list)
    placed: list[tuple[str, Stream]] = field(default_factory=list)
    rss: list[tuple[str, RssSeries]] = field(default_factory=list)
    rank: list[tuple[str, RankSeries]] = field(default_factory=list)
    void: list[InputError] = field(default_factory=list)


def _sort_log(found: _Found, settings: FlightFile, site: Site, files: Sequence[IngestedFile], number: int) -> None:
    """Add the streams of the log with this number, and warnings about it."""
    log, file = settings.logs[number], files[number]
    streams = [stream for stream in file.result.streams if stream.name not in log.skip]
    measured = (s for s in streams if s.kind in ("rss", "rank"))
    errors = {s.name: error for s in measured if (error := without_values(s, log.path)) is not None}
    streams = [s for s in streams if s.kind not in ("rss", "rank") or s.name not in errors]
    texts = [*file.result.warnings, *(f"{error.found}: it is ignored" for error in errors.values())]
    found.void += errors.values()
    found.telemetry += [(log.path, stream) for stream in streams if stream.kind == "telemetry"]
    heard = (s for s in streams if s.kind == "rss" and not _unnamed_cell(log, s))
    for stream in (s for s in heard if log.node or not is_own_radio(s)):
        # the sounder writes power and quality to separate files, which have similar paths for the same receiver
        alike = {id(f): len(os.path.commonprefix([f.path, file.path])) for f in files}  # noqa: RUF071
        others = sorted(files, key=lambda f: (f is not file, -alike[id(f)]))
        elsewhere = (candidate for source in others for candidate in source.result.streams)
        locked, remark = lock_of(stream, elsewhere)
        texts += [remark] if remark else []
        found.rss.append((log.path, _rss_series(settings.link, log, stream, site, number=number, locked=locked)))
    ranked = [stream for stream in streams if stream.kind == "rank"]
    found.placed += [(log.path, stream) for stream in ranked if "latitude_deg" in stream.frame]
    tower = log.node or settings.rank.tower
    found.rank += [(log.path, _rank_series(log, stream, site, tower=tower, number=number)) for stream in ranked]
    if unnamed := [s.name for s in file.result.streams if _unnamed_cell(log, s)]:
        texts.append(f"{counted(len(unnamed), 'cell')} ignored: not listed in 'cells'")
    names = [s.name for s in file.result.streams]
    keys = [*log.skip, *(key for key in log.cells if isinstance(key, str))]
    if unknown := [name for name in keys if name not in names]:
        texts.append(f"no stream is named {', '.join(unknown)}: its streams are {', '.join(names)}")
    texts += [*idle_log_keys(log, file), *_of_ratios(settings.link, log, file.result.streams)]
    texts += _of_carriers(settings.link, log, streams)
    found.warnings += [f"{log.path}: {text}" for text in texts]


def check_names(settings: FlightFile, site: Site, series: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """Check the towers and channels that settings name, and return cautions about learned antennas that do not fit.

    Parameters
    ----------
    settings : FlightFile
    site : Site
        Site with the towers of the flight.
    series : sequence of (tower, channel)
        All levels of the logs.

    Raises
    ------
    UsageError
        If neither site nor flight has a tower, or no log has a channel or a channel of a tower.
    """
    channels = list(dict.fromkeys(channel for _, channel in series))
    pairs = [f"{tower}.{channel}" for tower, channel in dict.fromkeys(series)]
    named = {**settings.antennas, **{c.key.removeprefix("antennas."): c for c in settings.cautions}}
    for key in sorted(named.keys() - {"uav", "rank.receiver", *pairs}):
        tower = key.partition(".")[0]
        unknown = ("channel", key) if tower in site.towers else ("tower", tower)
        _unknown(f"antennas.{key}", *unknown, ["uav", *pairs])
    for name in sorted(settings.link.channels.keys() - settings.lent - {*channels}):
        _unknown(f"link.channels.{name}", "channel", name, channels)
    links = {"rss": settings.link.rss, "rank": settings.link.rank}
    links |= {f"channels.{name}": settings.link.of(name) for name in settings.link.channels.keys() - settings.lent}
    for where, link in links.items():
        for name in sorted(link.towers.keys() - site.towers.keys()):
            _unknown(f"link.{where}.towers.{name}", "tower", name, list(site.towers))
    if settings.rank.tower not in site.towers and settings.rank.tower != RankSettings().tower:
        _unknown("rank.tower", "tower", settings.rank.tower, list(site.towers))
    return (*_learned_cautions(settings, channels), *_idle_channels(settings, channels))


def _unknown(key: str, kind: str, name: str, valid: Sequence[str]) -> NoReturn:
    near = nearest(name, valid)
    raise UsageError(
        f"{key}: this flight has no {kind} {name!r}",
        expected="one of " + ", ".join(valid) if valid else "no such key: the flight has no levels",
        cause=f"did you mean {near!r}?" if near else "a typing error, or a line of another flight",
    )


def _learned_cautions(settings: FlightFile, channels: Sequence[str]) -> tuple[str, ...]:
    """Return one sentence per caution about learned antennas, with the channels if only some are affected."""
    touched: dict[tuple[str, str], list[str]] = {}
    for caution in settings.cautions:
        # the channel None means all channels without a link of their own
        links = settings.link.channels if caution.channel is None else {*channels} - {caution.channel}
        concerned = [channel for channel in channels if channel not in links]
        if concerned or caution.key == "rank.receiver":
            touched.setdefault((caution.key, caution.text), []).extend(concerned)
    if settings.antennas and not channels:
        touched["antennas", "the logs have no levels, so no antenna is used"] = []
    texts = []
    for (key, text), on in touched.items():
        partial = key == "antennas.uav" and {*on} != {*channels}
        texts.append(f"{key}: {text} (channel {', '.join(on)})." if partial else f"{key}: {text}.")
    return tuple(texts)


def _idle_channels(settings: FlightFile, channels: Sequence[str]) -> tuple[str, ...]:
    """Return a sentence about channels of calibrations or overrides that no log has. Empty if there are none."""
    idle = sorted((settings.link.channels.keys() & settings.lent) - {*channels})
    text = f"link.channels names {', '.join(idle)}, which no log of this flight has: these settings are not used."
    return (text,) if idle else ()


def _unknown_receivers(settings: FlightFile, site: str | Path) -> tuple[str, ...]:
    """Return a sentence about receivers without a learned model that the flight file names. Empty if there are none."""
    named = {log.receiver for log in settings.logs if log.receiver}
    known: set[str] = set()
    with suppress(InputError, UsageError):
        entries = read_learned(site).entries if named else {}
        known = {series.receiver or name for name, entry in entries.items() for series in entry.series}
    new = ", ".join(sorted(named - known))
    text = f"logs: receiver {new} is not a learned receiver ({', '.join(sorted(known))}), so it has no effect."
    return (text,) if new and known else ()


def _undated(data: FlightData, track: str) -> list[str]:
    """Return the logs with positions whose times depend on 'time_origin' although the track has absolute times."""
    dated = {log.path for log in data.settings.logs if log.time_origin is not None}
    return [
        log.path
        for log, file in zip(data.settings.logs, data.files, strict=True)
        if log.path in dated
        and track not in dated
        and any(s.kind != "telemetry" and "latitude_deg" in s.frame for s in file.result.streams)
    ]


def _times_on_track(data: FlightData) -> list[tuple[str, Times]]:
    """Return names and times of the series whose positions come from the telemetry."""
    levels = [(f"RSS of {series.tower} {series.channel}", series.time) for series in data.rss]
    return levels + [(f"rank of {series.tower}", series.time) for series in data.rank if series.position_m is None]


def load_data(settings: FlightFile, folder: Path, logs_root: Path | None = None) -> FlightData:
    """Return the data of a flight: :func:`gather` for the logs of :func:`read_logs`.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Folder of the flight file.
    logs_root : Path, optional
        Folder of logs and antenna files, instead of ``folder``.
    """
    return gather(settings, folder, read_logs(settings, folder, logs_root), logs_root)


def _of_ratios(links: LinksSettings, log: LogSettings, streams: Sequence[Stream]) -> list[str]:
    """Return remarks about ratios that are compared as levels, because the noise power is unknown."""
    ratios = [s for s in streams if is_ratio(s) and s.name not in log.skip]
    blind = [s.name for s in ratios if _noise(s, links.of(_channel_of(log, s)))[0] is None]
    if not blind:
        return []
    shown = ", ".join(map(repr, blind)) + (" is a ratio" if len(blind) == 1 else " are ratios")
    return [
        f"{shown} to the noise, not a level, and compared as RSS over constant noise ('bandwidth_hz' "
        f"and 'noise_figure_db' of link.rss make an SNR absolute; 'skip: [{', '.join(blind)}]' next to the path "
        "excludes it)"
    ]


def _of_carriers(links: LinksSettings, log: LogSettings, streams: Sequence[Stream]) -> list[str]:
    """Return remarks about levels whose frequency differs from the carrier of their link."""
    carriers = [
        (s.name, float(s.attributes["frequency_hz"]), links.of(_channel_of(log, s)).carrier_hz)
        for s in streams
        if s.kind == "rss" and isinstance(s.attributes.get("frequency_hz"), float)
    ]
    return [
        f"{name!r} was measured at {log_hz / 1e6:g} MHz and is replayed at carrier_hz {hz / 1e6:g} MHz"
        for name, log_hz, hz in carriers
        if abs(log_hz / hz - 1.0) > _CARRIER_SHARE
    ]


# Relative difference of carriers at which free space differs by 0.4 dB.
_CARRIER_SHARE = 0.05


def _channel_of(log: LogSettings, stream: Stream) -> str:
    return log.channel or stream.channel


def _flown_track(site: Site, path: str, stream: Stream, settings: FlightFile) -> Track:
    """Return the track of the UAV, or raise InputError if no row has both position and height."""
    track = _track_of(site, scored_rows(stream, path)[0], settings)
    if not len(track) and lacks_height(stream):
        raise InputError(
            f"no altitude in {counted(len(stream.frame), 'telemetry row')}",
            expected="'height_m: H' next to its path, one height above take-off [m], or another track",
            cause="a phone or a drive-test program that writes only latitude and longitude",
            path=path,
        )
    if not len(track):
        raise InputError(
            f"{counted(len(stream.frame), 'telemetry row')} without a possible position",
            expected="latitude and longitude in degrees, altitude in metres",
            cause="a receiver without a fix, or swapped columns",
            path=path,
        )
    return track


# A flight farther than this from every tower belongs to another site [m].
_FAR_M = 30_000.0


def check_place(site: Site, path: str | Path, frame: pd.DataFrame, what: str = "flight") -> None:
    """Check that a flight or route is near a tower. Otherwise name the likely cause, such as swapped angles.

    Parameters
    ----------
    site : Site
    path : str or Path
        File for the message.
    frame : DataFrame
        ``latitude_deg`` and ``longitude_deg`` of the positions.
    what : {"flight", "route"}
        What the positions are, for the message.

    Raises
    ------
    InputError
        If no position is within :data:`_FAR_M` of any tower.
    """
    latitude, longitude = (frame[name].to_numpy(np.float64) for name in ("latitude_deg", "longitude_deg"))
    if not (near := nearest_m(site, latitude, longitude)) > _FAR_M:
        return
    causes = [why for why, angles in misread(latitude, longitude).items() if nearest_m(site, *angles) <= _FAR_M]
    raise InputError(
        f"the positions are at least {near / 1000.0:.0f} km from every tower of site {site.name!r}",
        expected=f"a {what} within {_FAR_M / 1000.0:.0f} km of a tower",
        cause=causes[0] if causes else f"another site, or another {what}",
        path=path,
    )


def nearest_m(site: Site, latitude_deg: FloatArray, longitude_deg: FloatArray) -> float:
    """Return the smallest horizontal distance of positions to any tower [m]. NaN without a position."""
    # skip impossible angles: the projection fails for them, and another check refuses them
    can = (np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0)
    if not can.any():
        return float("nan")
    east, north = site.frame.to_local(latitude_deg[can], longitude_deg[can])
    # compute one tower at a time to limit the memory for long flights
    gaps = [np.hypot(east - t.position_m[0], north - t.position_m[1]).min() for t in site.towers.values()]
    return float(np.min(gaps, initial=np.inf))


def _idle_attitude(data: FlightData) -> tuple[str, ...]:
    """Return warnings if ``rt.attitude`` has no effect, or an effect on only a part of the flight."""
    messages = []
    for kind, series in data.series:
        mode = data.settings.rank_rt.attitude if kind == "rank" else data.settings.rss_attitude
        if mode == "ignored":
            continue
        tower, time = series.tower, series.time
        pose = None if data.track is None else data.track.pose_at(time)
        known = 0 if pose is None else int((pose.attitude_known if mode == "logged" else pose.valid).sum())
        if known == 0:
            why = (
                "no log contains telemetry"
                if pose is None or data.track is None
                else "the telemetry contains no attitude: level flight along the course is assumed"
                if pose.valid.any()
                else f"no sample is within the telemetry: {data.track.why_not(pose)}"
            )
            messages.append(f"rt.attitude: {mode} has no effect on {kind} of {tower}: {why}.")
        elif pose is not None and kind == "rank" and not pose.valid.all():
            messages.append(
                f"rt.attitude: {mode} acts on {known} of {counted(len(time), 'sample')} of {kind} of {tower}: "
                "the telemetry does not cover the others."
            )
    return tuple(dict.fromkeys(messages))


def _known_tower(name: str | None, log: LogSettings, site: Site) -> str:
    if name is None:
        raise UsageError(
            f"log {log.path!r} does not specify its tower",
            expected="the tower, for example 'node: LW1', next to its path in flight.yaml",
        )
    if name not in site.towers:
        raise UsageError(
            f"log {log.path!r} names tower {name!r}, which site {site.name!r} does not have",
            expected="one of " + ", ".join(site.towers),
        )
    return name


def _unnamed_cell(log: LogSettings, stream: Stream) -> bool:
    """Check whether a stream belongs to a cell that is missing from ``cells`` of the flight file."""
    return bool(log.cells) and not {"pci", "part"}.isdisjoint(stream.attributes) and _home(log, stream) is None


def _home(log: LogSettings, stream: Stream) -> str | None:
    """Return the tower that ``cells`` assigns to a stream, by the PCI or the name of the stream."""
    return log.cells.get(int(stream.attributes.get("pci", -1)), log.cells.get(stream.name))


def _rss_series(
    links: LinksSettings, log: LogSettings, stream: Stream, site: Site, *, number: int, locked: FloatArray | None
) -> RssSeries:
    tower = _known_tower(_home(log, stream) or log.node or _text(stream, "node"), log, site)
    channel = _channel_of(log, stream)
    noise_dbm, link = _noise(stream, links.of(channel))
    frame, left_out = scored_rows(stream, log.path)
    return RssSeries(
        tower=tower,
        channel=channel,
        unit=str(stream.attributes.get("unit", "dB re full scale")),
        time=frame["time"].to_numpy("datetime64[ns]"),
        measured_db=frame["rss_db"].to_numpy(np.float64),
        link=link,
        settings_key=link.model_dump_json(),
        noise_dbm=noise_dbm,
        log=np.full(len(frame), number, dtype=np.int64),
        line=frame["line"].to_numpy(np.int64),
        flagged=left_out,
        locked=None if locked is None else locked[~unscored(stream.frame)],
        serving=frame["serving"].to_numpy(np.float64) if "serving" in frame else None,
    )


def _moving(path: str, series: RssSeries, track: Track, warnings: list[str]) -> RssSeries:
    """Return a series without the samples whose level is frozen in flight, and count them as flagged."""
    order = np.argsort(series.time, kind="stable")
    bad = np.zeros(len(order), dtype=np.bool_)
    bad[order] = frozen(series.time[order], series.measured_db[order], track.pose_at(series.time[order]).position_m)
    if not bad.any():
        return series
    warnings.append(
        f"{path}: {counted(int(bad.sum()), 'sample')} of {series.tower} {series.channel} repeat one level exactly "
        f"while the UAV flies on; the first: line {int(series.line[bad][0])}; flagged {FLAG}, not scored"
    )
    per_sample = ("time", "measured_db", "log", "line", "serving", "locked")
    kept = {name: column[~bad] for name in per_sample if (column := getattr(series, name)) is not None}
    return dataclasses.replace(series, **kept, flagged={**series.flagged, FLAG: int(bad.sum())})


def _rank_series(log: LogSettings, stream: Stream, site: Site, *, tower: str | None, number: int) -> RankSeries:
    home = _known_tower(tower, log, site)
    frame, left_out = scored_rows(stream, log.path)
    position = None
    if {"latitude_deg", "longitude_deg", "altitude_m"} <= set(frame.columns) and frame["latitude_deg"].notna().any():
        east, north = site.frame.to_local(frame["latitude_deg"], frame["longitude_deg"])
        takeoff_m = site.takeoff_ground_m  # altitude_m counts from the take-off point, as in the track
        up = frame["altitude_m"].to_numpy(np.float64) + takeoff_m
        up, buried = raised(up, site.ground_under_m(east, north), takeoff_m)
        # as in a track, samples below the ground or without a height have no position
        position = np.stack([east, north, np.where(buried | np.isnan(frame["altitude_m"]), np.nan, up)], axis=-1)
    sinr = frame["sinr_db"].to_numpy(np.float64) if "sinr_db" in frame else np.full(len(frame), np.nan)
    return RankSeries(
        tower=home,
        time=frame["time"].to_numpy("datetime64[ns]"),
        rank=frame["rank"].to_numpy(np.float64),
        sinr_db=sinr,
        position_m=position,
        flagged=left_out,
        log=np.full(len(frame), number, dtype=np.int64),
    )


Series = TypeVar("Series", "RssSeries", "RankSeries")


def _records(parts: Sequence[tuple[str, Series]], name: Callable[[Series], str]) -> tuple[Series, ...]:
    """Return one series per name, joining logs that follow each other, such as after a restart of the radio.

    Raises
    ------
    UsageError
        If two logs contain the same series at the same time, because only one of them could be compared.
    """
    groups = lists_by_key((name(series), (path, series)) for path, series in parts)
    return tuple(_record(what, group) for what, group in groups.items())


def _record(what: str, group: Sequence[tuple[str, Series]]) -> Series:
    if len(group) == 1:
        return group[0][1]
    # sort records with samples by time, independent of their order in the flight file
    parts = sorted((p for p in group if len(p[1].time)), key=lambda p: p[1].time.min()) or [group[0]]
    for (path, before), (later_path, after) in itertools.pairwise(parts):
        if after.time.min() < before.time.max() or _form(before) != _form(after):
            where, cause = f"two logs contain {what}", "a copy: remove one path, or use 'skip'"
            if path == later_path:
                where = f"two streams of one log contain {what}"
                cause = (
                    "a log that is listed twice, or two cells or devices: assign them to towers by "
                    "'cells: {STREAM: TOWER}'; 'ingest --all' lists the streams"
                )
            raise UsageError(
                f"{where} at the same time or with different properties: {path!r} and {later_path!r}",
                expected="one record of each channel and of each tower's rank",
                cause=f"{cause}; for another radio, set a separate 'channel'",
            )
    # take values that are not per sample (link, unit) from the first part
    first = parts[0][1]
    series = [part for _, part in parts]
    arrays: dict[str, Any] = {
        field.name: joined for field in dataclasses.fields(first) if len(joined := _joined(series, field.name))
    }
    voided = sum((Counter(series.flagged) for _, series in parts), Counter())
    return dataclasses.replace(first, flagged=dict(voided), **arrays)


def _joined(parts: Sequence[RssSeries | RankSeries], name: str) -> AnyArray:
    """Return a column of all parts, NaN for parts without it, such as a serving cell. Empty if no part has it."""
    arrays = [getattr(part, name) for part in parts]
    if not any(isinstance(value, np.ndarray) for value in arrays):
        return np.empty(0)
    return np.concatenate(
        [np.full(len(part.time), np.nan) if value is None else value for part, value in zip(parts, arrays, strict=True)]
    )


def _form(series: RssSeries | RankSeries) -> object:
    """Return the properties that must be equal in all parts of a series."""
    return series.unit if isinstance(series, RssSeries) else series.position_m is None


def _text(stream: Stream, key: str) -> str | None:
    value = stream.attributes.get(key)
    return None if value is None else str(value)


def _check_overlap(data: FlightData) -> None:
    """Check that every series overlaps in time with the track of the UAV, and with the track of a moving tower."""
    if not data.rss and not data.rank:
        raise UsageError(
            "none of the logs contains RSS or rank",
            expected="at least one radio log under 'logs'",
            cause="'skip', 'cells', or a missing line of logs",
        )
    for kind, series in data.series:
        what, placed = f"{kind} of {series.tower}", isinstance(series, RankSeries) and series.position_m is not None
        if data.track is None and not placed:
            raise UsageError(
                f"{what} has no positions and there is no telemetry log",
                expected="a telemetry log, such as vehicle_out, under 'logs'",
            )
        if data.track is not None and not placed:
            _check_shared(data, what, series.time, data.track)
        if series.tower in data.nodes and len(series.time):
            _check_shared(data, what, series.time, data.nodes[series.tower], node=series.tower)


# A log that ends before this year has relative times.
_FIRST_YEAR = 2000


def _check_shared(data: FlightData, what: str, time: Times, track: Track, node: str | None = None) -> None:
    """Check that times of a series overlap those of the telemetry, or of the track of a node."""
    start, end = np.datetime64(track.start_ns, "ns"), np.datetime64(track.end_ns, "ns")
    if len(time) and time.min() <= end and time.max() >= start:
        return
    shown = f"{pd.Timestamp(time.min())} .. {pd.Timestamp(time.max())}" if len(time) else "no samples"
    flown = f"{pd.Timestamp(start)} .. {pd.Timestamp(end)} (UTC)"
    cause, of = _clock_cause(data.settings.timezone, time, start, end), "telemetry"
    expected = "logs of the same flight"
    if node is not None:
        of, expected = "the track of this tower", "positions of the node during the flight"
        # a year near 1970 means that relative times have no origin
        if pd.Timestamp(end).year < _FIRST_YEAR:
            cause = "relative times: they require 'time_origin' next to the log"
        cause = cause.replace("next to the log", f"next to 'path' in towers.{node}.track")
    raise InputError(f"no overlap in time: {what} spans {shown}, {of} {flown}", expected=expected, cause=cause)


def _clock_cause(timezone: str | None, time: Times, start: np.datetime64, end: np.datetime64) -> str:
    apart = (time.min() - start) / np.timedelta64(ROLLOVER_DAYS, "D") if len(time) else 0.0
    late = time - np.timedelta64(ROLLOVER_DAYS * round(apart), "D")
    if round(apart) and late.min() <= end and late.max() >= start:
        of, count = ("telemetry", round(apart)) if apart > 0 else ("radio log", -round(apart))
        return (
            f"the week number of a GPS receiver rolled over: the {of} is {count * ROLLOVER_DAYS} days "
            f"({count * 1024} weeks) early; write 'gps_rollovers: {count}' next to its path"
        )
    trap = clock_trap((time.min(), time.max()), (start, end), timezone) if len(time) else None
    return "logs of different flights, or a wrong 'timezone' or 'clock'" if trap is None else trap.advice()


def rank_positions(series: RankSeries, track: Track | None) -> tuple[FloatArray, BoolArray]:
    """Return positions (n, 3) [m] from the log, or else from the track, and a mask (n,) of the known positions."""
    if series.position_m is None:
        assert track is not None
        pose = track.pose_at(series.time)
        return pose.position_m, pose.valid
    position = series.position_m
    known = np.isfinite(position).all(axis=1)
    if track is not None and not known.all():
        pose = track.pose_at(series.time)
        # decide per row, because a modem may temporarily have no fix
        use = ~known & pose.valid
        position, known = np.where(use[:, None], pose.position_m, position), known | use
    return position, np.asarray(known)
