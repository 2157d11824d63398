"""A first flight.yaml for logs that were just read.

A draft contains what the logs show, and a question where a user has to decide. A dry run counts the samples that a
report would score, and explains why the others are not scored.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import ceil, floor
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...common.errors import InputError, UsageError, one_line
from ...common.geodesy import rough_m
from ...common.text import counted
from ...common.units import BoolArray, FloatArray
from ...common.yamlfile import parse_yaml
from ...compare.level import detection_floor_db
from ...logs.ingest import IngestedFile, name_inside, read_log
from ...logs.readers import named_tower
from ...logs.records import Stream, has_wall_clock
from ...site.site import Site
from ...site.siteyaml import load_site
from ..clock import Origin, clock_trap, origin_of
from ..cross_checks import Flight, Span, flights, meet, questions, stream_span
from ..data import FlightData, Times, gather, is_own_radio, is_ratio, rank_positions, site_place
from ..gains import sight_shares
from ..rows import LOCK_FLOOR_DB, is_sounder_power, may_lose_lock
from ..settings import FlightFile, LogSettings, RssSettings
from ..track import height_in_name, interpolated, lacks_height, positions_over_time
from ..training import mark_of
from .proposals import (
    CARRIER_HZ,
    POWER_DBM,
    NodeFinder,
    Nodes,
    Placement,
    Proposal,
    Receiver,
    learned_towers,
    listed_places,
    propose,
    searching_airframe,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRun:
    """The result of a dry run.

    Parameters
    ----------
    samples : int
        Number of levels and ranks with a value, a position and at least the minimum height of the settings.
    refused : str
        The message with which a report would stop. Empty if it would run.
    lost : tuple of str
        Series with less than half of their samples compared, each with the reason.
    data : FlightData or None
        The gathered flight, or None if the report would stop.
    """

    samples: int = 0
    refused: str = ""
    lost: tuple[str, ...] = ()
    data: FlightData | None = None

    @property
    def reason(self) -> str:
        """The reason why no sample would be scored. Empty if a sample is scored."""
        return "" if self.samples else self.refused or "; ".join(self.lost)


def dry_run(settings: FlightFile, folder: Path, files: Sequence[IngestedFile]) -> DryRun:
    """Gather a flight as a report does, and count the samples that the report would score."""
    try:
        data = gather(settings, folder, files)
    except (InputError, UsageError) as error:
        return DryRun(refused=one_line(str(error)))
    lost: dict[str, str] = {}
    samples = 0
    for rss in data.rss:
        pose = data.poses_at(rss.time)
        counts = _counts(pose.position_m, pose.valid, rss.measured_db, settings.rss.minimum_height_m)
        samples += counts[-1]
        lost[f"{rss.tower} {rss.channel}"] = _loss(data, rss.time, counts)
    for rank in data.rank:
        counts = _counts(*rank_positions(rank, data.track), rank.rank, settings.rank.minimum_height_m)
        samples += counts[-1]
        lost[f"rank of {rank.tower}"] = _loss(data, rank.time, counts)
    return DryRun(samples=samples, lost=tuple(f"{name}: {why}" for name, why in lost.items() if why), data=data)


def _counts(place: FloatArray, known: BoolArray, value: FloatArray, lowest_m: float | None) -> tuple[int, int, int]:
    """Return the numbers of samples with a value, with a value and a position, and with both at a sufficient height."""
    valued = np.isfinite(value)
    placed = valued & known
    high = placed if lowest_m is None else placed & (place[:, 2] >= lowest_m)
    return int(valued.sum()), int(placed.sum()), int(high.sum())


def _loss(data: FlightData, time: Times, counts: tuple[int, int, int]) -> str:
    """Return the reason why less than half of the values of a series are compared. Empty if more are compared."""
    valued, placed, high = counts
    if not valued:
        return "no sample has a value (out of coverage, or no report)"
    if high and placed >= 0.5 * valued:
        return ""
    if placed and placed >= 0.5 * valued:
        return f"all of {counted(placed, 'sample')} below minimum_height_m"
    why = "there are no positions" if data.track is None else data.track.why_not(data.track.pose_at(time))
    return f"{high} of {counted(valued, 'sample')} within the telemetry: {why}"


_RADIO = re.compile(r"usrp-?([0-9]+)", re.IGNORECASE)

HEAD = """\
# A first draft for these logs, made by 'aerpaw-cmp ingest --draft'. Check every line with a question mark.
"""
LINK = (
    f"link:\n  rss: {{carrier_hz: {CARRIER_HZ / 1e9:g}e9, transmit_power_dbm: {POWER_DBM:g}, uav_transmits: true,"
    " bandwidth_hz: 20e6}  # levels below the noise of this bandwidth are out of coverage;"
    " do all values fit your experiment?\n"
)
_DOWNLINK = (
    f"link:\n  rss: {{carrier_hz: {CARRIER_HZ / 1e9:g}e9, transmit_power_dbm: {POWER_DBM:g}, uav_transmits: false}}"
    "  # downlink: the UAV receives, the unknown power is part of the offset; which carrier?\n"
)
_NO_TRACK = "  # no telemetry here: which vehicleOut log belongs to this flight?\n"
RANK = (
    "# Rank is compared for the paper's 4 x 4 arrays at 3.4 GHz, above the noise of 20 MHz, unless link.rank names"
    " others: is that your modem?\n"
)

SITE = "lake_wheeler"


@dataclass(frozen=True, slots=True, kw_only=True)
class DraftOptions:
    """Options of a draft.

    Parameters
    ----------
    timezone, time_origin : str, optional
        Time zone of clocks without a zone, and origin of relative times.
    mapping : mapping
        ``columns``, ``kind``, ``unit`` and ``ri_base`` of generic CSV files.
    site : str
        Packaged site, or path of a site.yaml relative to the folder. The learned antennas of this site are used.
    """

    timezone: str | None = None
    time_origin: str | None = None
    mapping: Mapping[str, Any] = field(default_factory=dict)
    site: str = SITE


def draft(
    files: Sequence[IngestedFile],
    folder: Path,
    options: DraftOptions = DraftOptions(),
    flight: LoggedFlight | None = None,
) -> tuple[str, list[str]]:
    """Return the text of a flight.yaml for logs, and remarks about it.

    Parameters
    ----------
    files : sequence of IngestedFile
        Files that ``ingest`` has read.
    folder : Path
        Folder of the flight.yaml. Paths in the text are relative to it.
    options : DraftOptions
    flight : LoggedFlight, optional
        The flight of the files. By default all files belong to one flight.

    Returns
    -------
    str, list of str
        The text, and remarks about what the user should check and what is not used.

    Raises
    ------
    UsageError
        If no log contains levels or ranks of a flight.
    """
    site = load_site(site_place(options.site, folder))
    own = files if flight is None else flight.own
    flown, which = _carrier(own, _flown(own), site)
    every = [stream for file in files for stream in file.result.streams]
    context = _Context(
        folder=folder,
        options=options,
        flown=flown,
        which=which,
        unsure={} if flight is None else flight.unsure,
        has_level=_has_level(files, flown),
        positioned=any(_has_positions(stream) for stream in every),
        locks=any(may_lose_lock(stream) for stream in every),
        towers=tuple(site.towers),
        shared=Path(os.path.commonpath([Path(file.path).resolve().parent for file in files] or [folder])),
        finder=_node_finder(files, flown, site),
    )
    lines = _lines(files, context)
    kinds = {stream.kind for line in lines for stream in line.compared}
    out = sorted(remark for line in lines for remark in line.remarks)
    if not kinds & {"rss", "rank"}:
        # a table of positions may contain levels under an unknown name, which its warnings list
        unread = [text for file in files for text in file.result.warnings if "--map" in text]
        # do not list unused tracks, because they are not the reason why there is no level
        radio = [line for line in lines if any(s.kind != "telemetry" for s in line.file.result.streams)]
        reasons = unread + sorted(remark for line in radio for remark in line.remarks)
        raise UsageError(
            "no log of RSS or rank for a flight" + "".join(f"; {remark}" for remark in reasons),
            expected="telemetry and levels or ranks of one flight",
        )
    name = _name(flown, files) if flight is None else flight.name
    link, used = _link(lines, own), [line for line in lines if line.entry]

    def text_with(known: Proposal) -> str:
        logs = [line.with_receiver(known.receivers.get(number)) for number, line in enumerate(used)]
        # include logs that are not used: one of them may have determined the position of a node that other logs share
        parts = _first_lines(name, [*(line for line in lines if not line.entry), *logs], out, context)
        learned_lines = _learned_lines(known, link) if "rss" in kinds else []
        rank = [RANK] if "rank" in kinds else []
        return "".join([*parts, *learned_lines, *rank, *_settings(lines, context, known)])

    # the counts in the remarks come from a dry run, which reads and gathers the flight as a report does
    proof = _proof(text_with(Proposal()), folder, [line.file for line in used])
    known, remarks = _learned_antennas(lines, context, proof.data)
    text = text_with(known)
    parse_yaml(text, FlightFile)  # an error here is a bug in this module
    if proof.reason:
        text = text.replace(HEAD, f"{HEAD}# No sample of this draft can be compared: {proof.reason}.\n", 1)
    # questions are at the ends of lines, so that a search in the file finds them
    checks = [f"check: {line.lstrip(' #-')}" for line in text.splitlines()[1:] if line.endswith("?")]
    proved = [f"no sample of this draft can be compared: {proof.reason}"]
    if not proof.reason:
        proved = [f"{counted(proof.samples, 'sample')} can be compared", *proof.lost]
    return text, proved + checks + [f"left out: {remark}" for remark in (*out, *remarks)]


def _first_lines(name: str, lines: Sequence[_Line], out: Sequence[str], context: _Context) -> list[str]:
    """Return the lines from the head of a draft to the end of ``logs:``."""
    parts = [HEAD, f"flight: {name}\n", f"site: {context.options.site}  # or your own site.yaml?\n"]
    towers = {place.node: place for line in lines for place in line.places if place.tower is not None}
    if towers:
        parts.append("towers:\n")
        parts += [f"  {node}: {_plain(place.tower or {})}  # {place.question}\n" for node, place in towers.items()]
    if context.options.timezone:
        parts.append(f"timezone: {context.options.timezone}\n")
    parts += ["logs:\n", *(line.text for line in lines)]
    if context.flown is None and not all(_has_positions(stream) for line in lines for stream in line.compared):
        parts.append(_NO_TRACK)
    return parts + [f"  # left out: {remark}\n" for remark in out]


def _link(lines: Sequence[_Line], own: Sequence[IngestedFile]) -> str:
    """Return the lines of ``link``, which is a downlink if all levels are RSRP of a phone or modem."""
    levels = [stream for line in lines for stream in line.compared if stream.kind == "rss"]
    link = _DOWNLINK if levels and all(s.attributes.get("quantity") == "RSRP" for s in levels) else LINK
    return link.replace("20e6", f"{_bandwidth_mhz([file.path for file in own]):g}e6")


def _proof(text: str, folder: Path, files: Sequence[IngestedFile]) -> DryRun:
    """Return the dry run of a draft's report. Logs whose times the draft changes are read again."""
    settings, read = parse_yaml(text, FlightFile), []
    for log, file in zip(settings.logs, files, strict=True):
        moved = log.time_origin is not None and any("clock" in s.attributes for s in file.result.streams)
        same = not moved and log.clock is None
        read.append(file if same else read_log(folder, log.path, log.options(settings.timezone), reader=log.reader))
    return dry_run(settings, folder, read)


@dataclass(frozen=True, slots=True)
class Draft:
    """A first flight.yaml.

    Parameters
    ----------
    name : str
        Name of the flight.
    text : str
    remarks : tuple of str
        What the user should check, and what is not used.
    """

    name: str
    text: str
    remarks: tuple[str, ...]


def drafts(files: Sequence[IngestedFile], folder: Path, options: DraftOptions = DraftOptions()) -> list[Draft]:
    """Return a flight.yaml for each flight of the logs, in the order of time.

    If only one flight is complete (levels or ranks, and positions), its draft lists all logs and marks those that are
    not used. See :func:`draft`.

    Parameters
    ----------
    files : sequence of IngestedFile
        Logs of one or several flights.
    folder : Path
        Folder of the drafts. Paths in the drafts are relative to this folder.
    options : DraftOptions

    Returns
    -------
    list of Draft
        One or more drafts.
    """
    groups = flights_by_name(files)
    written = []
    for name, flight in groups.items():
        text, remarks = draft(flight.files, folder, options, flight)
        written.append(Draft(name, text, tuple(remarks)))
    home = {file.path for flight in groups.values() for file in flight.files}
    homeless = [one_line(os.path.relpath(Path(f.path).resolve(), folder)) for f in files if f.path not in home]
    if homeless:
        first = written[0]
        out = tuple(f"left out: {path}: it does not belong to any flight here" for path in homeless)
        written[0] = Draft(first.name, first.text, (*first.remarks, *out))
    return written


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedFlight:
    """A flight that can be drafted.

    Parameters
    ----------
    name : str
    files : list of IngestedFile
        Files that its draft lists as used or not used.
    own : list of IngestedFile
        Files that belong to the flight.
    unsure : mapping of str to str
        Questions about files that may belong to another flight, by path.
    """

    name: str
    files: list[IngestedFile]
    own: list[IngestedFile]
    unsure: Mapping[str, str]


def flights_by_name(files: Sequence[IngestedFile]) -> dict[str, LoggedFlight]:
    """Return the flights that can be drafted, by name, in the order of time."""
    every = [flight for flight in flights(files) if flight.measured]
    # if no flight has a track, all are drafted
    complete = [flight for flight in every if flight.complete] or every
    named: dict[str, LoggedFlight] = {}
    for flight in complete or [Flight(list(files))]:
        name = _name(_flown(flight.files), flight.files)
        # two flights may have started in the same minute, or logs without times may share a folder
        taken = sum(other == name or other.startswith(f"{name}_") for other in named)
        name = f"{name}_{taken + 1}" if taken else name
        # if one flight is complete, its draft lists all other logs as not used
        inside = flight.files if len(complete) > 1 else list(files)
        named[name] = LoggedFlight(name=name, files=inside, own=flight.files, unsure=flight.unsure)
    return named


# Lower samples are from take-off, landing and waiting: at a height of 2 m, the airframe, its pilot and the grass
# determine the level.
MINIMUM_HEIGHT_M = 5

# Take-off and landing are excluded only from a flight that reached this height [m].
_FLOWN_ABOVE_M = 15.0


# Number of links that the audit of a first report checks.
_QUICK_AUDIT = 24

_QUICK = "  # a quick audit of the ray tracing; report --audit 200 for numbers to publish"


# Learned antennas are compared at a node whose 90 % region has at most this radius [m]. Its direction from a flight
# some hundred metres away is then known within some tens of degrees.
_SURE_M = 100.0


def _learned_antennas(lines: Sequence[_Line], context: _Context, data: FlightData | None) -> tuple[Proposal, list[str]]:
    """Return the learned antennas that fit, or an empty proposal and a remark if the models cannot be read."""
    if data is None:
        return Proposal(), []
    site = context.options.site
    towers = {p.node: p.tower for line in lines for p in line.places if p.tower is not None}
    placed = [name for name, tower in towers.items() if tower.get("region90_m", 0.0) <= _SURE_M]
    nodes = Nodes(placed=frozenset(placed), fixed=() if context.finder is None else context.towers)
    try:
        return propose(data, site_place(site, context.folder), str(Path(site).with_suffix("")), nodes), []
    except (InputError, UsageError) as error:
        return Proposal(), [f"learned antennas of site {site}: {error.found}; expected: {error.expected}"]


# Sampling rate in the names of sounder files and folders, such as 70m_fs20MHz.
_SAMPLING_RATE = re.compile(r"(?:^|[^a-z0-9])fs_?([0-9]+(?:\.[0-9]+)?) ?MHz", re.IGNORECASE)


def _bandwidth_mhz(paths: Sequence[str]) -> float:
    """Return the bandwidth of the receiver [MHz]: the sampling rate in file names, else the bandwidth of the sounder.

    Examples
    --------
    >>> _bandwidth_mhz(["a/40m_fs5MHz.mat"]), _bandwidth_mhz(["a/log.txt"]), _bandwidth_mhz(["fs5MHz/a", "fs10MHz/a"])
    (5.0, 20.0, 20.0)
    """
    # use the last rate in a path: a folder of several rates contains a folder per rate
    rates = {float(found[-1]) for path in paths if (found := _SAMPLING_RATE.findall(str(path)))}
    return rates.pop() if len(rates) == 1 else _SOUNDER_MHZ


_SOUNDER_MHZ = 20.0


def _learned_lines(known: Proposal, link: str) -> list[str]:
    """Return the lines of ``antennas`` and ``link``."""
    if not known.antennas:
        return [link, *([f"# antennas: {known.antennas_about}\n"] if known.antennas_about else [])]
    assert known.carrier_hz is not None
    return [
        f"antennas: {_plain(dict(known.antennas))}  # {known.antennas_about}; the same airframe?\n",
        link.replace(f"{CARRIER_HZ / 1e9:g}e9", f"{known.carrier_hz / 1e9:g}e9", 1),
    ]


def _settings(lines: Sequence[_Line], context: _Context, known: Proposal) -> list[str]:
    """Return the lines for ``rt``, ``rss`` and ``rank``."""
    kinds = {stream.kind for line in lines for stream in line.compared}
    written = _replay_lines(lines, context, known)
    placed = [s for line in lines for s in line.compared if _has_positions(s)]
    flown_high = (
        max(map(_top_m, placed if context.track is None else [context.track]), default=-np.inf) > _FLOWN_ABOVE_M
    )
    low: dict[str, Any] = {"minimum_height_m": MINIMUM_HEIGHT_M} if flown_high else {}
    for kind in sorted(kinds & {"rss", "rank"}, reverse=True):
        chosen: dict[str, Any] = dict(low)
        reasons = ["without take-off and landing"] if low else []
        if kind == "rss" and context.flown is not None:
            chosen |= {"field": "power"}
            reasons.append("powers of paths are added, because the phases of real ground reflections are unknown")
            if span := _span_of_offsets([offset for line in lines for offset in line.offsets_db]):
                chosen |= span
                reasons.append("the levels are outside the usual search range of offsets")
        elif kind == "rank" and known.receiver:
            chosen |= {"receiver": known.receiver}
            reasons.append(known.receiver_about)
        if chosen:
            written.append(f"{kind}: {_plain(chosen)}  # {'; '.join(reasons)}\n")
    return written


def _replay_lines(lines: Sequence[_Line], context: _Context, known: Proposal) -> list[str]:
    """Return ``rt`` if there is a track."""
    if context.flown is None:
        return []
    alone = ", max_depth: 0" if known.antennas else ""  # the gains were learned with the direct path only
    shaded, why = _shaded(lines, context)
    alone += shaded
    if any(stream.kind == "rank" for line in lines for stream in line.compared):
        return [
            *why,
            "# To use rt.attitude: logged, write the mounting of link.rank.uav relative to the aircraft's nose.\n",
            f"rt: {{audit_links: {_QUICK_AUDIT}{shaded}}}{_QUICK}\n",
        ]
    frame, keys = context.flown[0].frame, f"{alone}, audit_links: {_QUICK_AUDIT}"
    if _has_attitude(frame):
        line = f"rt: {{attitude: logged{keys}}}{_QUICK}\n"
    elif _has_attitude(frame, ("yaw_deg",)):
        line = f"rt: {{attitude: level{keys}}}{_QUICK}; level, with the logged heading\n"
    else:
        line = (
            f"rt: {{attitude: level{keys}}}"
            "  # a quick audit; no attitude in the telemetry: the nose points along the track?\n"
        )
    return [*why, line]


# Number of positions whose sight lines are tested, and the share of blocked lines above which woods or buildings
# matter.
_SIGHTS, _SHADED_SHARE = 200, 0.01


def _shaded(lines: Sequence[_Line], context: _Context) -> tuple[str, list[str]]:
    """Return the keys of ``rt`` for links through woods or behind buildings, and comments with the share of links."""
    if context.finder is None:
        return "", []
    site, positions = context.finder.site, context.finder.positions_m(_SIGHTS)
    towers = {_key(s, line.entry)[0] for line in lines for s in line.compared if s.kind != "telemetry"}
    names = sorted(towers & set(site.towers))
    if not names or not len(positions):
        return "", []
    wooded, hidden = (float(share) for share in np.mean([sight_shares(site, n, positions) for n in names], axis=0))
    keys, comments = "", []
    if wooded >= _SHADED_SHARE:
        keys += ", foliage: attenuating"
        comments.append(f"# {wooded:.0%} of the sight lines pass through woods, so woods attenuate.\n")
    if hidden >= _SHADED_SHARE:
        keys += ", diffraction: edges"
        comments.append(f"# {hidden:.0%} of the sight lines are behind buildings: edges diffract.\n")
    return keys, comments


# Margin of the proposed search range around the median offsets from free space [dB].
_MARGIN_DB = 20.0


def _span_of_offsets(offsets_db: Sequence[float]) -> dict[str, Any]:
    """Return ``span_db`` if the default search range would end near an expected offset."""
    usual = RssSettings().span_db
    if not offsets_db:
        return {}
    low, high = min(offsets_db) - _MARGIN_DB, max(offsets_db) + _MARGIN_DB
    if usual[0] <= low and high <= usual[1]:
        return {}
    return {"span_db": [10 * floor(low / 10.0), 10 * ceil(high / 10.0)]}


def _node_finder(files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None, site: Site) -> NodeFinder | None:
    """Return the proposals for nodes. None if there is no track at the site."""
    if flown is None or lacks_height(flown[0]):
        return None
    listed = listed_places(Path(file.path).resolve().parent for file in files)
    finder = NodeFinder(site, flown[0], listed)
    return finder if finder.at_site else None


def _has_attitude(frame: Any, names: Sequence[str] = ("roll_deg", "pitch_deg", "yaw_deg")) -> bool:
    """Check whether most telemetry rows contain the attitude of the aircraft."""
    known = set(names) <= set(frame.columns) and frame[list(names)].notna().all(axis=1).mean() > 0.5
    return bool(known and frame["yaw_deg"].any())


def receiver_floor_db(levels: Sequence[Stream]) -> float | None:
    """Return the floor of the receivers of a log [dB]. None if the levels do not show a floor.

    A receiver at its floor repeats its lowest level: in at least 1 % of the samples, and at least ten times.
    """
    # RSRP is reported in whole decibels, so its lowest value repeats without a floor
    compared = [stream for stream in levels if stream.attributes.get("quantity") != "RSRP"]
    floors = (detection_floor_db(stream.frame["rss_db"].to_numpy(np.float64)) for stream in compared)
    return max((floor for floor in floors if floor is not None), default=None)


def floor_of(level: Stream, *, locks: bool) -> float:
    """Return the floor of the receiver of a level [dB], or -inf if it is unknown.

    ``locks`` is True if a log of the flight contains the lock quality of a sounder.
    """
    if locks and is_sounder_power(level):
        return LOCK_FLOOR_DB
    found = receiver_floor_db([level])
    return -np.inf if found is None else found


@dataclass(frozen=True, slots=True, kw_only=True)
class _Context:
    """The flight, its site and the options, which are the same for all logs of a draft.

    Parameters
    ----------
    folder : Path
        Folder of flight.yaml.
    options : DraftOptions
    flown : (Stream, Span), optional
        The telemetry that is used as the track, and its time span.
    which : str
        Question about the vehicle, which is empty if only one vehicle flew.
    unsure : mapping of str to str
        Questions about files that may belong to another flight, by path.
    has_level : bool
        True if a log of the flight contains levels of the experiment.
    positioned : bool
        True if a log of ranks contains its own positions.
    locks : bool
        True if the receiver is a sounder that can lose its lock.
    towers : sequence of str
        Towers of the site.
    shared : Path
        Innermost folder that contains all logs.
    finder : NodeFinder, optional
        Proposals for nodes, or None if there is no track at the site.
    """

    folder: Path
    options: DraftOptions
    flown: tuple[Stream, Span] | None
    which: str
    unsure: Mapping[str, str]
    has_level: bool
    positioned: bool
    locks: bool
    towers: Sequence[str]
    shared: Path
    finder: NodeFinder | None

    @property
    def track(self) -> Stream | None:
        """The telemetry that is used as the track."""
        return None if self.flown is None else self.flown[0]

    def leads(self, file: IngestedFile) -> bool:
        """Check whether the track is in this file."""
        return any(stream is self.track for stream in file.result.streams)

    def shift(self, stream: Stream) -> np.timedelta64:
        """Return the time to add to a UTC clock that was read as local time. The result is 0 for other clocks."""
        span = stream_span(stream)
        # a clock is not corrected if the log itself specifies its UTC offset
        if self.flown is None or span is None or stream.kind == "telemetry":
            return np.timedelta64(0, "m")
        trap = clock_trap(span, self.flown[1], self.options.timezone)
        written = stream.attributes.get("clock_from") == "written"
        hours = trap.hours if trap is not None and trap.is_utc and not written else 0.0
        return np.timedelta64(round(60 * hours), "m")

    def span(self, stream: Stream) -> Span | None:
        """Return the time span of a stream on the clock that the draft assumes. None if it has no samples."""
        span, shift = stream_span(stream), self.shift(stream)
        return None if span is None else (span[0] + shift, span[1] + shift)

    def is_utc(self, file: IngestedFile) -> bool:
        """Check whether a log without a zone overlaps the telemetry if its times are UTC, but not if they are local."""
        return any(self.shift(stream) for stream in file.result.streams)

    def dated(self, stream: Stream, origin: Origin | None) -> Stream:
        """Return a stream at the times that the draft assumes for it."""
        shift = self.shift(stream)
        if origin is not None and stream.attributes.get("clock") == "relative":
            shift += origin.time - np.datetime64(0, "ns")
        return replace(stream, frame=stream.frame.assign(time=stream.frame["time"] + shift)) if shift else stream


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """A log of a draft, with its line in ``logs:`` or the reasons why it is not used.

    Parameters
    ----------
    file : IngestedFile
    shown : str
        Path relative to the flight.yaml, for messages.
    entry : mapping
        Keys of the line, empty if the log is not used.
    comment : str
        Comment at the end of the line, with reasons and questions.
    remarks : tuple of str
        Streams that are not compared, with the reason.
    compared : tuple of Stream
    places : tuple of Placement
        Nodes that the levels of this log fit.
    offsets_db : tuple of float
        Median of free space minus the level, for each channel [dB].
    """

    file: IngestedFile
    shown: str
    entry: Mapping[str, Any] = field(default_factory=dict)
    comment: str = ""
    remarks: tuple[str, ...] = ()
    compared: tuple[Stream, ...] = ()
    places: tuple[Placement, ...] = ()
    offsets_db: tuple[float, ...] = ()

    @property
    def text(self) -> str:
        """The line with its questions, or an empty text if the log is not used."""
        return f"  - {_flow(dict(self.entry))}{self.comment}\n" if self.entry else ""

    def with_receiver(self, receiver: Receiver | None) -> _Line:
        """Return the line with the receiver of its levels, or with the question for it."""
        if receiver is None:
            return self
        named = {"receiver": receiver.name} if receiver.name else {}
        return replace(self, entry={**self.entry, **named}, comment=_also(self.comment, receiver.about))


def _lines(files: Sequence[IngestedFile], context: _Context) -> list[_Line]:
    """Return a line per log: telemetry first, then all other logs in the order of the files."""
    lines: list[_Line] = []

    def samples(file: IngestedFile) -> int:
        return sum(len(s.frame) for s in file.result.streams if s.kind != "telemetry")

    # the first of several copies is used, so sort copies on the telemetry's clock, then copies with more samples, to
    # the front
    for file in sorted(files, key=lambda f: (not context.leads(f), context.is_utc(f), -samples(f))):
        lines.append(_line(file, context, lines))
    order = {file.path: number for number, file in enumerate(files)}
    return sorted(lines, key=lambda line: (not context.leads(line.file), order[line.file.path]))


def _line(file: IngestedFile, context: _Context, earlier: Sequence[_Line]) -> _Line:
    """Return the line of one log. Its series are not used if an ``earlier`` log has them."""
    path = os.path.relpath(Path(file.holder or file.path).resolve(), context.folder)
    path = str(Path(path, name_inside(file.path))) if file.holder else path
    shown = one_line(path)
    first = next((line.shown for line in earlier if line.file.sha256 == file.sha256), shown)
    if first != shown:
        return _Line(file=file, shown=shown, remarks=(f"{shown}: the same bytes as {first}",))
    if any("\ud800" <= letter <= "\udfff" for letter in path):  # bytes that are not UTF-8, as Python represents them
        remark = f"{shown}: flight.yaml cannot contain a name that is not UTF-8; rename the file"
        return _Line(file=file, shown=shown, remarks=(remark,))
    streams = [s for s in file.result.streams if s.kind != "kpi"]  # reports do not compare KPIs
    origin = None if context.options.time_origin else _origin(streams, context.flown)
    entry, comment, places = _with_node(file, path, streams, origin, context, earlier)
    if context.is_utc(file):
        entry["clock"] = "utc"
        comment = _also(comment, "it overlaps the telemetry as UTC but not as local time: is it UTC?")
    if label := _another_channel(streams, entry, earlier):
        entry["channel"] = label
        comment = _also(comment, "another receiver of this tower, whose name the log does not contain: which?")
    refused = _refused(streams, entry, shown, context, earlier, dated=origin is not None)
    compared = [s for s in streams if s.name not in refused]
    reasons = list(dict.fromkeys(refused.values()))
    line = _Line(file=file, shown=shown, places=places)
    if not compared and reasons == [_RATIO] and all(may_lose_lock(s) for s in streams):
        skipped = {"path": path, "reader": file.result.reader, "skip": [s.name for s in streams]}
        return replace(line, entry=skipped, comment="  # shows when the receiver was in lock")
    if not compared:
        return replace(line, remarks=(f"{shown}: {'; '.join(reasons) or 'no samples'}",))
    if all(s.kind == "telemetry" for s in compared):
        # a track has no tower and no channel
        entry, comment = {"path": path, "reader": file.result.reader}, ""
    if context.options.time_origin and any("clock" in s.attributes for s in compared):
        entry["time_origin"] = context.options.time_origin
    elif origin is not None:
        entry["time_origin"] = f"{origin.time.astype('datetime64[ms]')}Z"
        comment = _also(comment, f"time_origin from two tracks {origin.distance_m:.1f} m apart: the same flight?")
    # a report needs the mapping of columns to read the file
    entry |= context.options.mapping if file.result.reader == "generic_csv" else {}
    entry |= {"skip": sorted(refused)} if refused else {}
    keys, asked = _heights_and_floor(compared, path, context.track)
    entry |= keys
    asked += [context.which] if context.which and context.leads(file) else []
    asked += [context.unsure[file.path]] if file.path in context.unsure else []
    for question in (*asked, *questions(file, compared, context.options.timezone)):
        comment = _also(comment, question)
    line = replace(line, entry=entry, comment=comment, compared=tuple(compared))
    nodes = _nodes([*earlier, line])
    offsets = (_offset_db(context.dated(s, origin), entry, nodes, context) for s in compared)
    return replace(
        line,
        remarks=tuple(f"{shown}: {name}: {reason}" for name, reason in refused.items() if reason != _RATIO),
        offsets_db=tuple(offset for offset in offsets if offset is not None),
    )


def _heights_and_floor(compared: Sequence[Stream], path: str, track: Stream | None) -> tuple[dict[str, Any], list[str]]:
    """Return the keys for a missing height and for the floor of the receiver, and the questions about them."""
    keys: dict[str, Any] = {}
    asked = []
    if any(lacks_height(s) for s in compared if s is track or _has_positions(s)):
        height = height_in_name(path)
        keys |= {} if height is None else {"height_m": height}
        asked.append(
            "no altitude in the log: what is height_m?" if height is None else "height_m from the file's name?"
        )
    if (floor := receiver_floor_db([s for s in compared if s.kind == "rss"])) is not None:
        # a hundredth above the floor, because levels at or below floor_db are out of coverage
        keys["floor_db"] = round(floor + 0.01, 2)
        asked.append(f"floor of the receiver at {floor:.1f} dB?")
    if any(is_ratio(s) for s in compared):
        asked.append("use a signal-to-noise ratio as a level?")
    return keys, asked


def _nodes(lines: Sequence[_Line]) -> dict[str, FloatArray]:
    """Return the positions of the nodes that the levels of some logs fit, by name."""
    return {p.node: p.position_m for line in lines for p in line.places if p.position_m is not None}


def _with_node(
    file: IngestedFile,
    path: str,
    streams: Sequence[Stream],
    origin: Origin | None,
    context: _Context,
    earlier: Sequence[_Line],
) -> tuple[dict[str, Any], str, tuple[Placement, ...]]:
    """Return the keys of a log with its nodes, the question about them, and the nodes that its levels fit."""
    entry, comment = _entry(file, path, context.towers, context.shared)
    finder = context.finder
    if finder is None:
        return entry, comment, ()
    proper = (s for s in streams if not (context.has_level and is_own_radio(s)))
    levels = [context.dated(s, origin) for s in proper if s.kind == "rss" and not is_ratio(s)]
    if not comment:
        return entry, _doubt(entry, levels, finder, context), ()
    places: list[Placement] = []
    for cell in entry.get("cells", [None]):
        # receivers of one node are at one position, so the first level suffices
        level = next((s for s in levels if cell is None or _cell_of(s) == cell), None)
        if level is None:
            continue
        nodes = _nodes([*earlier, _Line(file=file, shown="", places=tuple(places))])
        place = _placement(file, level, finder, context, nodes)
        if place is None:
            continue
        places.append(place)
        if cell is None:
            entry["node"] = place.node
            comment = f"  # {place.question}" if place.tower is None and place.question else ""
        else:
            entry["cells"][cell] = place.node
    return entry, comment, tuple(places)


def _placement(
    file: IngestedFile, level: Stream, finder: NodeFinder, context: _Context, nodes: Mapping[str, FloatArray]
) -> Placement | None:
    """Return the tower or position that a level fits. None if the level has too few samples."""
    site = site_place(context.options.site, context.folder)
    log = file.sha256, mark_of(level.frame["time"].to_numpy(), level.frame["rss_db"].to_numpy(np.float64))
    track = finder.levels(level, floor_of(level, locks=context.locks))
    antennas = learned_towers(site, log, loses_lock=False)
    return finder.propose(track, antennas, nodes, partial(searching_airframe, site, log, track))


def _doubt(entry: Mapping[str, Any], levels: Sequence[Stream], finder: NodeFinder, context: _Context) -> str:
    """Return a question if a name specifies a tower that the levels contradict."""
    for level in levels:
        node = str(entry.get("node") or level.attributes.get("node"))
        better = finder.contradiction(finder.levels(level, floor_of(level, locks=context.locks)), node)
        if better is not None:
            return f"  # the name says {node}, the levels fit {better} far better: which tower?"
    return ""


def _offset_db(
    level: Stream, entry: Mapping[str, Any], nodes: Mapping[str, FloatArray], context: _Context
) -> float | None:
    """Return the median of free space minus the level [dB]. None if the node of the level is unknown."""
    if context.finder is None or level.kind != "rss":
        return None
    cell = entry.get("cells", {}).get(_cell_of(level))
    node = str(cell or entry.get("node") or level.attributes.get("node"))
    return context.finder.offset_db(context.finder.levels(level, floor_of(level, locks=context.locks)), node, nodes)


def _origin(streams: Sequence[Stream], flown: tuple[Stream, Span] | None) -> Origin | None:
    """Return the origin of relative times whose positions are on the track of the flight."""
    if flown is None or not has_wall_clock(flown[1][0]):
        return None
    relative = [s for s in streams if s.attributes.get("clock") == "relative"]
    return next((origin for s in relative if (origin := origin_of(s, flown[0])) is not None), None)


def _refused(
    streams: Sequence[Stream],
    entry: Mapping[str, Any],
    shown: str,
    context: _Context,
    earlier: Sequence[_Line],
    *,
    dated: bool,
) -> dict[str, str]:
    """Return the streams of a log that are not compared, by name, with the reason.

    ``dated`` is True if relative times have an origin.
    """
    leading = _leading(streams)
    taken = [
        (_key(s, line.entry), context.span(s), line.shown)
        for line in earlier
        for s in line.compared
        if s.kind != "telemetry"
    ]
    refused = {}
    # of several ranks in a log, use the rank with the most values
    for stream in sorted(streams, key=_missing):
        span, key = context.span(stream), _key(stream, entry)
        if span is None:
            why: str | None = "no samples"
        elif stream.name in leading:
            why = f"it is from the same receiver and cell as {leading[stream.name]}, which is compared"
        else:
            why = _reason(stream, span, context, dated=dated)
        if not why and stream.kind != "telemetry":
            source = next((at for k, when, at in taken if k == key and when and span and meet(span, when)), None)
            if source is not None:
                where = "another stream of the log" if source == shown else source
                why = f"{where} already has {key[1]} of that tower at that time"
            else:
                taken.append((key, span, shown))
        if why:
            refused[stream.name] = why
    return refused


# Two logs contain the same measurement, in whatever form, if the difference of their means over this time [s] has a
# standard deviation below this [dB]. For the levels of two antennas, it is some decibels.
_MEANS_S, _OTHER_READINGS_DB = 2.0, 1.0


def _another_channel(streams: Sequence[Stream], entry: Mapping[str, Any], earlier: Sequence[_Line]) -> str:
    """Return a channel name for a log if another log has different levels of the same tower and name at the same time.

    The name is empty for logs that name their channel or have cells, and for the first log and its copies.
    """
    levels = [s for s in streams if s.kind == "rss" and not is_ratio(s)]
    if len(levels) != 1 or {"cells", "channel"} & entry.keys() or levels[0].channel != levels[0].name:
        return ""
    tower, name = _key(levels[0], entry)
    others = [
        s
        for line in earlier
        for s in line.compared
        if s.kind == "rss" and _key(s, line.entry)[0] == tower and s.channel == name
    ]
    differences = [_difference_sd_db(levels[0], other) for other in others]
    return f"{name}_{len(others) + 1}" if others and min(differences) > _OTHER_READINGS_DB else ""


def _difference_sd_db(first: Stream, second: Stream) -> float:
    """Return the standard deviation of the difference of two levels [dB], or 0 if they have no common time."""
    means = []
    for stream in (first, second):
        step = (stream.frame["time"].to_numpy("datetime64[ns]").astype(np.int64) * 1e-9 // _MEANS_S).astype(np.int64)
        means.append(stream.frame["rss_db"].groupby(step).mean())
    difference = (means[0] - means[1]).dropna()
    return float(difference.std()) if len(difference) > 1 else 0.0


def _reason(stream: Stream, span: Span, context: _Context, *, dated: bool) -> str | None:
    """Return the reason why a stream cannot be compared along the track of the flight. None if it can be compared."""
    relative, flown = not has_wall_clock(span[0]), context.flown
    if stream.kind == "telemetry":
        if flown is None or stream is flown[0]:
            return None
        if meet(span, flown[1]) or (relative and has_wall_clock(flown[1][0])):
            return "the track comes from other telemetry"
        return _late(span, flown[1])
    if flown is None and context.positioned and not _has_positions(stream):
        return "it has no positions, and there is no telemetry"
    same_clock = flown is not None and not has_wall_clock(flown[1][0])  # both times are relative
    if relative and not (dated or same_clock or _has_positions(stream)):
        return "its times are relative; read it again with --time-origin"
    if same_clock and not relative:
        return "the times of the track are relative; read it again with --time-origin"
    if flown is not None and not relative and not meet(span, flown[1]):
        return _late(span, flown[1], context.options.timezone)
    if context.has_level and is_own_radio(stream):
        return "the telemetry radio; the flight has levels of the experiment"
    return _RATIO if context.has_level and is_ratio(stream) else None


_RATIO = "a signal-to-noise ratio, not a level"


def _late(span: Span, flown: Span, timezone: str | None = None) -> str:
    trap = clock_trap(span, flown, timezone)
    shown = [" .. ".join(str(t.astype("datetime64[s]")).replace("T", " ") for t in s) for s in (span, flown)]
    return f"{shown[0]} is outside the time of the telemetry, {shown[1]} (UTC)" + (f": {trap.advice()}" if trap else "")


def _missing(stream: Stream) -> int:
    """Return the number of missing values of a rank, 0 for other streams."""
    return int(stream.frame["rank"].isna().sum()) if stream.kind == "rank" else 0


def _leading(streams: Sequence[Stream]) -> dict[str, str]:
    """Return the streams with other quantities of a receiver and cell that also has RSRP, with the name of the RSRP."""
    leaders: dict[object, str] = {}
    same = {}
    # prefer RSRP, because RSSI and wideband power of a cell also contain its load and its neighbours
    for stream in sorted(streams, key=lambda s: s.attributes.get("quantity") != "RSRP"):
        if stream.kind != "rss" or "quantity" not in stream.attributes:
            continue
        cell = tuple(stream.attributes.get(key) for key in ("node", "rat", "pci", "arfcn", "part"))
        if stream.attributes["quantity"] == "RSRP" and cell not in leaders:
            leaders[cell] = stream.name
        elif cell in leaders and not is_ratio(stream):
            same[stream.name] = leaders[cell]
    return same


def _key(stream: Stream, entry: Mapping[str, Any]) -> tuple[str, str]:
    """Return the tower and channel by which a report distinguishes series."""
    tower = str(entry.get("node") or stream.attributes.get("node"))
    if stream.kind == "rank":
        return tower, "rank"
    return tower, str(entry.get("channel") or stream.channel)


def _top_m(stream: Stream) -> float:
    """Return the greatest height above take-off [m], or -inf if no height is known."""
    if "altitude_m" not in stream.frame:
        return -np.inf
    return float(np.nanmax(stream.frame["altitude_m"].to_numpy(np.float64), initial=-np.inf))


def _has_positions(stream: Stream) -> bool:
    return stream.kind == "rank" and "latitude_deg" in stream.frame and bool(stream.frame["latitude_deg"].notna().any())


def _has_level(files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None) -> bool:
    """Check whether a stream of the flight is a level of the experiment."""
    proper = (s for file in files for s in file.result.streams if not is_own_radio(s))
    levels = [s for s in proper if s.kind == "rss" and not is_ratio(s)]
    spans = [span for s in levels if (span := stream_span(s))]
    return any(flown is None or meet(span, flown[1]) for span in spans)


def _flown(files: Sequence[IngestedFile]) -> tuple[Stream, Span] | None:
    """Return the telemetry that overlaps most levels and ranks, and its time span. In a tie, return the longest."""
    timed = [(stream, span, file) for file in files for stream in file.result.streams if (span := stream_span(stream))]
    measured = [span for s, span, _ in timed if s.kind != "telemetry" and has_wall_clock(span[0])]
    tracks = [(s, span, file) for s, span, file in timed if s.kind == "telemetry"]
    telemetry = [(s, span) for s, span, _ in tracks if has_wall_clock(span[0])]
    relative = [
        (s, span)
        for s, span, file in tracks
        if not has_wall_clock(span[0]) and any(other.kind in ("rss", "rank") for other in file.result.streams)
    ]

    def worth(flight: tuple[Stream, Span]) -> tuple[int, np.timedelta64]:
        return sum(meet(flight[1], span) for span in measured), flight[1][1] - flight[1][0]

    # if no telemetry has a wall clock, a log with both levels and positions is a flight with relative times
    return max(telemetry or relative[:1], key=worth, default=None)


# Positions of one aircraft in the logs of its autopilot and of another program differ by less than this [m].
_ONE_VEHICLE_M = 30.0

# Log evidence per bin by which the levels must fit one vehicle better.
_SURE_OF_VEHICLE = 0.1


def _carrier(
    files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None, site: Site
) -> tuple[tuple[Stream, Span] | None, str]:
    """Choose the vehicle whose track fits the levels best at any tower.

    Also return a question if several vehicles flew.

    Parameters
    ----------
    files : sequence of IngestedFile
    flown : (Stream, Span), optional
        Telemetry that overlaps most levels and ranks.
    site : Site
    """
    if flown is None:
        return None, ""
    tracks = [flown]
    for stream in (s for file in files for s in file.result.streams if s.kind == "telemetry" and s is not flown[0]):
        span = stream_span(stream)
        if span is not None and meet(span, flown[1]) and _median_distance_m(stream, flown[0]) > _ONE_VEHICLE_M:
            tracks.append((stream, span))
    if len(tracks) == 1:
        return flown, ""
    levels = [s for file in files for s in file.result.streams if s.kind == "rss" and not is_ratio(s)]
    evidence = [max((NodeFinder(site, s).evidence(level) for level in levels), default=-np.inf) for s, _ in tracks]
    order = np.argsort(evidence)
    # every vehicle must have evidence: a track without levels does not show that another vehicle carried the radio
    sure = np.isfinite(evidence).all() and evidence[order[-1]] - evidence[order[-2]] > _SURE_OF_VEHICLE
    best = tracks[order[-1]] if sure else flown
    named = " and ".join(stream.name for stream, _ in tracks)
    apart = max(_median_distance_m(stream, flown[0]) for stream, _ in tracks[1:])
    fit = f", and the levels fit {best[0].name}" if sure else ""
    return best, f"{named} flew at this time, {apart:.0f} m apart{fit}: which of them carried the radio?"


def _median_distance_m(first: Stream, second: Stream) -> float:
    """Return the median distance of two tracks while both were logged [m], or 0 if it is unknown."""
    (time, place), (at, other) = (positions_over_time(stream.frame) for stream in (first, second))
    if len(time) < 2 or len(at) < 2:
        return 0.0
    both = (time >= at[0]) & (time <= at[-1])
    flown = (place[both], interpolated(time[both], at, other))
    here, there = (rough_m(some[:, 0], some[:, 1], other[0]) for some in flown)
    return float(np.median(np.linalg.norm(here - there, axis=1))) if both.any() else 0.0


# Largest number of cells that are proposed. In a city, a phone reports a hundred cells, so only those with the most
# samples are proposed.
MOST_CELLS = 6


# Attributes that identify a cell without a PCI. Channels, ports and antennas of one node are not cells.
_OF_CELL = re.compile(r"(cell|sector|[eg]nb|bs|base_station|e?ci|nci|[en]?cgi)(_.*)?")


def _cell_of(stream: Stream) -> int | str | None:
    """Return the key of a stream in ``cells:``: its PCI, or its name if another attribute identifies the cell."""
    if "pci" in stream.attributes:
        return int(stream.attributes["pci"])
    return stream.name if any(map(_OF_CELL.fullmatch, stream.attributes)) else None


def _cells(streams: Sequence[Stream]) -> list[int | str]:
    """Return the cells of a log that have at least a twentieth of the samples of the most frequent cell."""
    counts = {cell: len(s.frame) for s in streams if (cell := _cell_of(s)) is not None}
    most = max(counts.values(), default=0)
    most_sampled = sorted(counts, key=lambda cell: -counts[cell])[:MOST_CELLS]
    # right-aligned numbers sort by value, and can be compared with names
    return sorted((cell for cell in most_sampled if 20 * counts[cell] >= most), key="{:>9}".format)


def _entry(file: IngestedFile, path: str, towers: Sequence[str], shared: Path) -> tuple[dict[str, Any], str]:
    """Return the keys of a log and, if the node is a guess, a question about it."""
    entry: dict[str, Any] = {"path": path, "reader": file.result.reader}
    need = [s for s in file.result.streams if s.kind in ("rss", "rank") and not s.attributes.get("node")]
    if not need:
        return entry, ""
    here = Path(file.path).resolve()
    # a home folder may have the name of a tower: search only the names of the file, its folder, and folders below the
    # draft or the common folder of the logs
    below = str(here.relative_to(shared)) if path.startswith(("/", "..")) else path
    near = named_tower("/".join(here.parts[-2:]), towers) or named_tower(below, towers)
    alone = towers[0] if len(towers) == 1 else None
    entry["node"] = near or named_tower(path, towers) or alone or next(iter(towers), "LW1")
    if cells := _cells(need):
        entry["cells"] = dict.fromkeys(cells, entry["node"])
        if all(_cell_of(stream) is not None for stream in need):
            del entry["node"]
        return entry, "  # which tower has which " + ("PCI?" if isinstance(cells[0], int) else "cell?")
    if (radio := _RADIO.findall(path)) and len(need) == 1 and need[0].kind == "rss":
        entry["channel"] = f"USRP{radio[-1]}"
    return entry, "" if near or alone else "  # which tower?"


def _also(comment: str, question: str) -> str:
    """Return the comment at the end of a line of ``logs:`` with one more question."""
    return f"{comment} {question}" if comment else f"  # {question}"


def _plain(entry: Mapping[str, Any]) -> str:
    """Return a mapping of plain names on one line of YAML."""
    # on one line, because a question follows at its end
    return str(yaml.safe_dump(dict(entry), default_flow_style=True, sort_keys=False, width=10_000)).strip()


def _flow(entry: dict[str, Any]) -> str:
    """Return the YAML mapping of a log on one line.

    All texts are quoted if one of them would be read as a number, such as 1e6.
    """

    def dumped(style: str | None) -> str:
        text = yaml.safe_dump(
            entry, default_flow_style=True, sort_keys=False, width=10_000, allow_unicode=style is None,
            default_style=style,
        )  # fmt: skip
        return str(text).strip()

    text = dumped(None)
    try:
        # a name such as 1e6 or 12:30 can change, because our reader follows YAML 1.2 and the writer YAML 1.1
        as_read = len(text.splitlines()) == 1 and parse_yaml(text, LogSettings).path == entry["path"]
    except UsageError:
        as_read = False
    return text if as_read else dumped('"')


# Earlier times are not used in the name of a flight, because they are relative, or come from a clock that was never
# set.
_FIRST_CLOCK = np.datetime64("1981")


def _name(flown: tuple[Stream, Span] | None, files: Sequence[IngestedFile]) -> str:
    """Return the name of a flight: its first time, or else the name of its only log or of the folder."""
    if flown is None or flown[1][0] < _FIRST_CLOCK:
        place = Path(files[0].path).resolve()
        stem = place.stem if flown is not None and len(files) == 1 else place.parent.name
        # flight.name allows these letters
        return re.sub(r"[^A-Za-z0-9_.-]", "_", stem).lstrip("_.-") or "flight"
    return "flight_" + str(flown[1][0].astype("datetime64[m]")).replace("T", "_").replace(":", "")
