"""A first flight.yaml for logs that were just read: what can be told from them is filled in, the rest is asked for.

Number of samples of a flight that a report would score, and why not more, before anything is replayed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
    Nodes,
    Placer,
    Proposal,
    listed_places,
    propose,
    searching_airframe,
    taught,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRun:
    """Outcome of a dry run.

    Parameters
    ----------
    samples : int
        Levels and ranks with a position, a value and the height that the settings ask for.
    refused : str
        The message with which a report would stop; empty where it would not.
    lost : tuple of str
        Per series of which none, or less than half, is compared: which, and the reason.
    data : FlightData or None
        The gathered flight; None if the report would stop.
    """

    samples: int = 0
    refused: str = ""
    lost: tuple[str, ...] = ()
    data: FlightData | None = None

    @property
    def reason(self) -> str:
        """Reason why nothing would be scored; empty where something is."""
        return "" if self.samples else self.refused or "; ".join(self.lost)


def dry_run(settings: FlightFile, folder: Path, files: Sequence[IngestedFile]) -> DryRun:
    """Gather a flight as a report does, by :func:`~aerpaw_cmp.flight.data.gather`, and count what could be scored."""
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
    """Samples with a value; those of them with a position; those of them that are high enough."""
    valued = np.isfinite(value)
    placed = valued & known
    high = placed if lowest_m is None else placed & (place[:, 2] >= lowest_m)
    return int(valued.sum()), int(placed.sum()), int(high.sum())


def _loss(data: FlightData, time: Times, counts: tuple[int, int, int]) -> str:
    """Give the reason why none, or less than half, of the values of a series is compared; empty for others."""
    valued, placed, high = counts
    if not valued:
        return "no sample holds a value (out of coverage, or no report)"
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
    " bandwidth_hz: 20e6}  # out of coverage below the noise of this bandwidth; all as in your experiment?\n"
)
_DOWNLINK = (
    f"link:\n  rss: {{carrier_hz: {CARRIER_HZ / 1e9:g}e9, transmit_power_dbm: {POWER_DBM:g}, uav_transmits: false}}"
    "  # downlink: the UAV receives, the power is unknown and stands in the offset; which carrier?\n"
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
        What zone-less clocks and relative times were read with.
    mapping : mapping
        ``columns``, ``kind``, ``unit`` and ``ri_base`` that generic CSVs were read with.
    site : str
        Packaged site, or the path of a site.yaml against the folder; what it remembers of antennas is used.
    """

    timezone: str | None = None
    time_origin: str | None = None
    mapping: Mapping[str, Any] = field(default_factory=dict)
    site: str = SITE


def draft(
    files: Sequence[IngestedFile],
    folder: Path,
    options: DraftOptions = DraftOptions(),
    flight: NamedFlight | None = None,
) -> tuple[str, list[str]]:
    """The text of a flight.yaml that names the logs.

    Parameters
    ----------
    files : sequence of IngestedFile
        As ``ingest`` read them.
    folder : Path
        Of the flight.yaml; the paths in it are relative to it.
    options : DraftOptions
    flight : NamedFlight, optional
        The flight of the files; by default all are of one.

    Returns
    -------
    str, list of str
        The text, and what is left to check or was left out.

    Raises
    ------
    UsageError
        If no log has what a flight needs.
    """
    site = options.site
    place = load_site(site_place(site, folder))
    own = files if flight is None else flight.own
    flown, which = _carrier(own, _flown(own), place)
    every = [stream for file in files for stream in file.result.streams]
    entries = _Entries(
        folder=folder,
        flown=flown,
        which=which,
        unsure={} if flight is None else flight.unsure,
        has_level=_has_level(files, flown),
        options=options,
        positioned=any(_has_positions(stream) for stream in every),
        towers_known=tuple(place.towers),
        placer=_placer(files, flown, place),
        locks=any(may_lose_lock(stream) for stream in every),
    )
    # of copies, the one on the telemetry's clock, then the fullest
    for file in sorted(files, key=lambda f: (not entries.leads(f), entries.is_utc(f), -_samples(f))):
        entries.enter(file)
    entries.sort(files)
    if not entries.kinds & {"rss", "rank"}:
        # a table of positions says which of its columns may be levels under a name that nobody knows
        unread = [text for file in files for text in file.result.warnings if "--map" in text]
        raise UsageError(
            "no log of RSS or rank for a flight" + "".join(f"; {remark}" for remark in (*entries.out, *unread)),
            expected="telemetry and levels or ranks of one flight",
        )
    parts = [
        HEAD,
        f"flight: {_name(entries.flown, files) if flight is None else flight.name}\n",
        f"site: {site}  # or your own site.yaml?\n",
    ]
    if entries.towers:
        parts += [
            "towers:\n",
            *(f"  {name}: {_plain(tower)}  # {about}\n" for name, (tower, about) in entries.towers.items()),
        ]
    if options.timezone:
        parts.append(f"timezone: {options.timezone}\n")
    parts += ["logs:\n", *entries.lines.values()]
    parts += [_NO_TRACK] if entries.without_track else []
    parts += [f"  # left out: {remark}\n" for remark in entries.out]
    link = _DOWNLINK if entries.downlink and all(entries.downlink) else LINK
    link = link.replace("20e6", f"{_bandwidth_mhz([file.path for file in own]):g}e6")

    def text_with(known: Proposal) -> str:
        lines = _learned_lines(known, link) if "rss" in entries.kinds else []
        lines += [RANK] if "rank" in entries.kinds else []
        return "".join([*parts, *lines, *_settings(entries, known)])

    # the draft is read and gathered as a report would: what it promises is true
    proof = _proof(text_with(Proposal()), folder, {file.path: file for file in files}, list(entries.lines))
    known, remark = _remembered(entries, site, folder, proof.data)
    text = text_with(known)
    parse_yaml(text, FlightFile)  # a draft that its own reader refuses is a fault of ours
    entries.out += remark
    if proof.reason:
        text = text.replace(HEAD, f"{HEAD}# No sample of this draft can be compared: {proof.reason}.\n", 1)
    # questions stand at the ends of lines, so that the file itself can be searched for them
    checks = [f"check: {line.lstrip(' #-')}" for line in text.splitlines()[1:] if line.endswith("?")]
    proved = [f"no sample of this draft can be compared: {proof.reason}"]
    if not proof.reason:
        proved = [f"{counted(proof.samples, 'sample')} can be compared", *proof.lost]
    return text, proved + checks + [f"left out: {remark}" for remark in entries.out]


def _proof(text: str, folder: Path, files: Mapping[str, IngestedFile], paths: Sequence[str]) -> DryRun:
    """Dry run of the draft's report: the samples it would score; logs whose times the draft moves are read again."""
    settings, read = parse_yaml(text, FlightFile), []
    for log, path in zip(settings.logs, paths, strict=True):
        moved = log.time_origin is not None and any("clock" in s.attributes for s in files[path].result.streams)
        same = not moved and log.clock is None
        again = files[path] if same else read_log(folder, log.path, log.options(settings.timezone), reader=log.reader)
        read.append(again)
    return dry_run(settings, folder, read)


@dataclass(frozen=True, slots=True)
class Draft:
    """A first flight.yaml.

    Parameters
    ----------
    name : str
        Of the flight.
    text : str
    remarks : tuple of str
        What is left to check, or was left out.
    """

    name: str
    text: str
    remarks: tuple[str, ...]


def drafts(files: Sequence[IngestedFile], folder: Path, options: DraftOptions = DraftOptions()) -> list[Draft]:
    """A flight.yaml for each flight that the logs are of, in the order of time; see :func:`draft`.

    Where one flight alone is complete (levels or ranks, and positions) all logs stand in its draft, those that do not
    belong to it as left out.

    Parameters
    ----------
    files : sequence of IngestedFile
        Logs of one or of several flights.
    folder : Path
        Against which the paths are written.
    options : DraftOptions

    Returns
    -------
    list of Draft
        At least one; its remarks say what is left to check.
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
        out = tuple(f"left out: {path}: it goes with no flight here" for path in homeless)
        written[0] = Draft(first.name, first.text, (*first.remarks, *out))
    return written


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedFlight:
    """A flight that can be drafted.

    Parameters
    ----------
    name : str
    files : list of IngestedFile
        All that its draft names or leaves out.
    own : list of IngestedFile
        Those that belong to it.
    unsure : mapping of str to str
        Questions about those that may belong to another flight, by path.
    """

    name: str
    files: list[IngestedFile]
    own: list[IngestedFile]
    unsure: Mapping[str, str]


def flights_by_name(files: Sequence[IngestedFile]) -> dict[str, NamedFlight]:
    """Flights that can be drafted, by name, in the order of time."""
    every = [flight for flight in flights(files) if flight.measured]
    # one flight alone is complete: all other logs stand in its draft, as left out
    complete = [flight for flight in every if flight.complete] or every  # without any track each waits for its own
    named: dict[str, NamedFlight] = {}
    for flight in complete or [Flight(list(files))]:
        name = _name(_flown(flight.files), flight.files)
        # two flights of one minute, or a folder without times
        taken = sum(other == name or other.startswith(f"{name}_") for other in named)
        name = f"{name}_{taken + 1}" if taken else name
        inside = flight.files if len(complete) > 1 else list(files)
        named[name] = NamedFlight(name=name, files=inside, own=flight.files, unsure=flight.unsure)
    return named


# Samples below it are take-off, landing and waiting: at 2 m an airframe, its pilot and the grass decide the level.
MINIMUM_HEIGHT_M = 5

# A flight that never got higher has no part that is better than its start.
_FLOWN_ABOVE_M = 15.0


# Links that the audit of a first report checks.
_QUICK_AUDIT = 24

_QUICK = "  # a quick audit of the ray tracing; report --audit 200 for numbers to publish"


# A node that is placed this well is seen from a flight some hundred metres away within some tens of degrees.
_SURE_M = 100.0


def _remembered(entries: _Entries, site: str, folder: Path, data: FlightData | None) -> tuple[Proposal, list[str]]:
    """Return the learned antennas that fit; nothing, and a remark, if they cannot be read."""
    if data is None:
        return Proposal(), []
    towers = () if entries.placer is None else tuple(entries.placer.site.towers)
    nodes = Nodes(placed=frozenset(entries.sure), fixed=towers)
    try:
        return propose(data, site_place(site, folder), str(Path(site).with_suffix("")), nodes), []
    except (InputError, UsageError) as error:
        return Proposal(), [f"learned antennas of site {site}: {error.found}; expected: {error.expected}"]


# Sampling rate in the names of sounder files and folders, such as 70m_fs20MHz.
_SAMPLING_RATE = re.compile(r"(?:^|[^a-z0-9])fs_?([0-9]+(?:\.[0-9]+)?) ?MHz", re.IGNORECASE)


def _bandwidth_mhz(paths: Sequence[str]) -> float:
    """Return the bandwidth of the receiver [MHz]: the sampling rate in file names, else that of the sounder.

    Examples
    --------
    >>> _bandwidth_mhz(["a/40m_fs5MHz.mat"]), _bandwidth_mhz(["a/log.txt"]), _bandwidth_mhz(["fs5MHz/a", "fs10MHz/a"])
    (5.0, 20.0, 20.0)
    """
    # the last name counts: a folder of several rates contains folders of one
    rates = {float(found[-1]) for path in paths if (found := _SAMPLING_RATE.findall(str(path)))}
    return rates.pop() if len(rates) == 1 else _SOUNDER_MHZ


_SOUNDER_MHZ = 20.0


def _learned_lines(known: Proposal, link: str) -> list[str]:
    """``antennas`` and ``link``."""
    if not known.antennas:
        return [link, *([f"# antennas: {known.antennas_about}\n"] if known.antennas_about else [])]
    assert known.carrier_hz is not None
    return [
        f"antennas: {_plain(dict(known.antennas))}  # {known.antennas_about}; the same airframe?\n",
        link.replace(f"{CARRIER_HZ / 1e9:g}e9", f"{known.carrier_hz / 1e9:g}e9", 1),
    ]


def _settings(entries: _Entries, known: Proposal) -> list[str]:
    """Lines for ``rt``, ``rss`` and ``rank`` that real logs ask for."""
    lines = _replay_lines(entries, known)
    low: dict[str, Any] = {"minimum_height_m": MINIMUM_HEIGHT_M} if entries.highest_m() > _FLOWN_ABOVE_M else {}
    for kind in sorted(entries.kinds & {"rss", "rank"}, reverse=True):
        chosen: dict[str, Any] = dict(low)
        reasons = ["without take-off and landing"] if low else []
        if kind == "rss" and entries.flown is not None:
            chosen |= {"field": "power"}
            reasons.append("powers of paths added: phases of a real ground are not known")
            if span := _span_of_offsets(entries.offsets_db):
                chosen |= span
                reasons.append("the levels lie outside the usual span of offsets")
        elif kind == "rank" and known.receiver:
            chosen |= {"receiver": known.receiver}
            reasons.append(known.receiver_about)
        if chosen:
            lines.append(f"{kind}: {_plain(chosen)}  # {'; '.join(reasons)}\n")
    return lines


def _replay_lines(entries: _Entries, known: Proposal) -> list[str]:
    """``rt``, where there is a track."""
    if entries.flown is None:
        return []
    alone = ", max_depth: 0" if known.antennas else ""  # the gains were learned beside line of sight alone
    shaded, why = _shaded(entries)
    alone += shaded
    if "rank" in entries.kinds:
        return [
            *why,
            "# rt.attitude: logged needs link.rank.uav mounted as seen from the aircraft's nose.\n",
            f"rt: {{audit_links: {_QUICK_AUDIT}{shaded}}}{_QUICK}\n",
        ]
    frame, keys = entries.flown[0].frame, f"{alone}, audit_links: {_QUICK_AUDIT}"
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


# Positions at which sight lines are looked along, and the share of lines from which woods or buildings count.
_SIGHTS, _SHADED_SHARE = 200, 0.01


def _shaded(entries: _Entries) -> tuple[str, list[str]]:
    """Keys of ``rt`` for links through woods or behind buildings, and comments with the share of their sight lines."""
    if entries.placer is None:
        return "", []
    site, positions = entries.placer.site, entries.placer.positions_m(_SIGHTS)
    names = sorted(entries.at_towers & set(site.towers))
    if not names or not len(positions):
        return "", []
    wooded, hidden = (float(share) for share in np.mean([sight_shares(site, n, positions) for n in names], axis=0))
    keys, comments = "", []
    if wooded >= _SHADED_SHARE:
        keys += ", foliage: attenuating"
        comments.append(f"# {wooded:.0%} of the sight lines pass through woods: woods attenuate.\n")
    if hidden >= _SHADED_SHARE:
        keys += ", diffraction: edges"
        comments.append(f"# {hidden:.0%} of the sight lines are behind buildings: edges diffract.\n")
    return keys, comments


# Of the searched offsets about those that free space expects.
_MARGIN_DB = 20.0


def _span_of_offsets(offsets_db: Sequence[float]) -> dict[str, Any]:
    """``span_db`` where the usual one would end near an expected offset."""
    usual = RssSettings().span_db
    if not offsets_db:
        return {}
    low, high = min(offsets_db) - _MARGIN_DB, max(offsets_db) + _MARGIN_DB
    if usual[0] <= low and high <= usual[1]:
        return {}
    return {"span_db": [10 * floor(low / 10.0), 10 * ceil(high / 10.0)]}


def _placer(files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None, site: Site) -> Placer | None:
    """Proposals for nodes, where there is a track at the site."""
    if flown is None or lacks_height(flown[0]):
        return None
    listed = listed_places(Path(file.path).resolve().parent for file in files)
    placer = Placer(site, flown[0], listed)
    return placer if placer.at_site else None


def _has_attitude(frame: Any, names: Sequence[str] = ("roll_deg", "pitch_deg", "yaw_deg")) -> bool:
    """Check whether most telemetry rows know how the aircraft is turned."""
    known = set(names) <= set(frame.columns) and frame[list(names)].notna().all(axis=1).mean() > 0.5
    return bool(known and frame["yaw_deg"].any())


_CLIPPED_SHARE = 0.01


def receiver_floor_db(levels: Sequence[Stream]) -> float | None:
    """The level [dB] below which the receivers of a log hear nothing; None where none shows.

    A receiver at its floor writes its least level again and again: at least one sample in a hundred, and at least ten.
    """
    floors = []
    for stream in levels:
        level = stream.frame["rss_db"].to_numpy(np.float64)
        level = level[np.isfinite(level)]
        if len(level) and np.sum(level == level.min()) >= max(10.0, _CLIPPED_SHARE * len(level)) and np.ptp(level) > 0:
            floors.append(float(level.min()))
    return max(floors) if floors else None


@dataclass
class _Entries:
    """Lines of ``logs:``, and remarks on what stays out."""

    folder: Path
    flown: tuple[Stream, Span] | None
    """The telemetry that gives the track, and its span."""
    has_level: bool
    options: DraftOptions
    lines: dict[str, str] = field(default_factory=dict)
    """By the path as it was given."""
    kinds: set[str] = field(default_factory=set)
    at_towers: set[str] = field(default_factory=set)
    """Towers of all levels and ranks."""
    out: list[str] = field(default_factory=list)
    without_track: bool = False
    """A record was entered that needs a track, and there is none."""
    entered: dict[tuple[str, ...], list[tuple[Span, str]]] = field(default_factory=dict)
    """By tower, kind and channel: when, and from which log."""
    contents: dict[str, str] = field(default_factory=dict)
    """Path by SHA-256."""
    positioned: bool = False
    """Some log to compare has positions of its own."""
    which: str = ""
    """Question about the vehicle, where several flew."""
    unsure: Mapping[str, str] = field(default_factory=dict)
    """Questions about files that may be of another flight, by path."""
    towers_known: Sequence[str] = ()
    """Towers of the site."""
    placer: Placer | None = None
    locks: bool = False
    """The receiver is a sounder that loses its lock."""
    towers: dict[str, tuple[Mapping[str, Any], str]] = field(default_factory=dict)
    """Nodes that the site does not have, and the question about each."""
    offsets_db: list[float] = field(default_factory=list)
    """Expected of each level."""
    sure: set[str] = field(default_factory=set)
    """Those of them whose place is known well enough for the directions of an antenna."""
    downlink: list[bool] = field(default_factory=list)
    """Of each level: what a phone or modem reports of its cell."""
    tops_m: list[float] = field(default_factory=list)
    """Greatest height of each log that has positions of its own and is compared at them."""

    def highest_m(self) -> float:
        """Greatest height [m] of the track, or of logs with positions of their own where there is no track."""
        return max(self.tops_m, default=-np.inf) if self.flown is None else _top_m(self.flown[0])

    @property
    def _track(self) -> Stream | None:
        return None if self.flown is None else self.flown[0]

    def leads(self, file: IngestedFile) -> bool:
        """Check whether the track is in this file."""
        return any(s is self._track for s in file.result.streams)

    def sort(self, files: Sequence[IngestedFile]) -> None:
        """Lines in the order of the files, telemetry first."""
        order = [f.path for f in sorted(files, key=lambda f: not self.leads(f))]
        self.lines = {path: self.lines[path] for path in order if path in self.lines}
        self.out.sort()

    def enter(self, file: IngestedFile) -> None:
        """One log: a line of ``logs:``, or the reason why not."""
        path = os.path.relpath(Path(file.holder or file.path).resolve(), self.folder)
        path = str(Path(path, name_inside(file.path))) if file.holder else path
        shown = one_line(path)
        if (first := self.contents.setdefault(file.sha256, shown)) != shown:
            self.out.append(f"{shown}: the same bytes as {first}")
        elif any("\ud800" <= letter <= "\udfff" for letter in path):  # bytes that are no UTF-8, as Python holds them
            self.out.append(f"{shown}: flight.yaml cannot hold a name that is not UTF-8; rename it")
        else:
            self._enter(file, path, shown)

    def _enter(self, file: IngestedFile, path: str, shown: str) -> None:
        streams = [s for s in file.result.streams if s.kind != "kpi"]  # no report compares these
        entry, comment = _entry(file, path, self.towers_known)
        origin = None if self.options.time_origin else self._origin(streams)
        if self.placer is not None:
            proper = (s for s in streams if not (self.has_level and is_own_radio(s)))
            levels = [self._dated(s, origin) for s in proper if s.kind == "rss" and not is_ratio(s)]
            if comment:
                comment = self._place(file, entry, comment, levels, self.placer)
            else:
                comment = self._doubt(entry, levels, self.placer)
        if self.is_utc(file):
            entry["clock"] = "utc"
            # the telemetry decides: the same numbers fit as UTC and not as local time
            comment = _also(comment, "as local time it misses the telemetry, as UTC it meets it: is it UTC?")
        refused = self._refused(streams, entry, shown, dated=origin is not None)
        compared = [s for s in streams if s.name not in refused]
        reasons = list(dict.fromkeys(refused.values()))
        if not compared and reasons == [_RATIO] and all(may_lose_lock(s) for s in streams):
            comment = "  # says when the receiver was in lock"
            skip = [s.name for s in streams]
            self.lines[file.path] = (
                f"  - {_flow({'path': path, 'reader': file.result.reader, 'skip': skip})}{comment}\n"
            )
            return
        if not compared:
            self.out.append(f"{shown}: {'; '.join(reasons) or 'no samples'}")
            return
        self.out += [f"{shown}: {name}: {reason}" for name, reason in refused.items() if reason != _RATIO]
        if all(s.kind == "telemetry" for s in compared):
            # a track has no tower and no channel
            entry, comment = {"path": path, "reader": file.result.reader}, ""
        if self.options.time_origin and any("clock" in s.attributes for s in compared):
            entry["time_origin"] = self.options.time_origin
        elif origin is not None:
            entry["time_origin"] = f"{origin.time.astype('datetime64[ms]')}Z"
            comment = _also(comment, f"time_origin by tracks {origin.distance_m:.1f} m apart: the same flight?")
        # what was said of its columns has to stand in the draft, or the report cannot read it
        if file.result.reader == "generic_csv":
            entry |= self.options.mapping
        if refused:
            entry["skip"] = sorted(refused)
        comment = self._ask_heights_and_floor(compared, entry, path, comment)
        asked = [self.which] if self.which and self.leads(file) else []
        asked += [self.unsure[file.path]] if file.path in self.unsure else []
        for question in (*asked, *questions(file, compared, self.options.timezone)):
            comment = _also(comment, question)
        self.lines[file.path] = f"  - {_flow(entry)}{comment}\n"
        if self.placer is not None:
            offsets = (self._offset_db(self._dated(s, origin), entry, self.placer) for s in compared)
            self.offsets_db += [offset for offset in offsets if offset is not None]
        self.kinds |= {s.kind for s in compared}
        self.tops_m += [_top_m(s) for s in compared if _has_positions(s)]
        self.at_towers |= {_key(s, entry)[0] for s in compared if s.kind in ("rss", "rank")}
        self.downlink += [s.attributes.get("quantity") == "RSRP" for s in compared if s.kind == "rss"]
        self.without_track |= self.flown is None and not all(_has_positions(s) for s in compared)

    def _ask_heights_and_floor(self, compared: Sequence[Stream], entry: dict[str, Any], path: str, comment: str) -> str:
        """Fill in a missing height and the floor of the receiver; gives what there is to ask.

        Parameters
        ----------
        compared : sequence of Stream
            Of the file, those that are compared.
        entry : dict
            Of the file in ``logs:``; receives height and floor.
        path : str
        comment : str
            What is asked already.

        Returns
        -------
        str
        """
        if any(lacks_height(s) for s in compared if s is self._track or _has_positions(s)):
            height = height_in_name(path)
            entry |= {} if height is None else {"height_m": height}
            question = (
                "no altitude in the log: which height_m?" if height is None else "height_m as the file's name says?"
            )
            comment = _also(comment, question)
        levels = [
            s for s in compared if s.kind == "rss" and s.attributes.get("quantity") != "RSRP"
        ]  # whole decibels repeat
        if (floor := receiver_floor_db(levels)) is not None:
            # a hundredth above: levels at or below the floor are out of coverage
            entry["floor_db"] = round(floor + 0.01, 2)  # at the floor is below it
            comment = _also(
                comment, f"floor of the receiver at {floor:.1f} dB?" if comment else f"receiver floor {floor:.1f} dB?"
            )
        if any(is_ratio(s) for s in compared):
            comment = _also(comment, "a ratio to the noise as a level?")
        return comment

    def _place(
        self, file: IngestedFile, entry: dict[str, Any], comment: str, levels: Sequence[Stream], placer: Placer
    ) -> str:
        """Fill in the nodes that the levels fit; gives what is left to ask.

        Parameters
        ----------
        file : IngestedFile
        entry : dict
            Of the file in ``logs:``; receives the nodes.
        comment : str
            The question where no level fits.
        levels : sequence of Stream
            Of the file.
        placer : Placer

        Returns
        -------
        str
        """
        places, memory = {}, site_place(self.options.site, self.folder)
        # None: a log without cells is one level
        for pci in entry.get("cells", [None]):
            # the first of its kind: receivers of one node stand at one place
            level = next((s for s in levels if pci is None or _cell_of(s) == pci), None)
            if level is not None:
                mark = mark_of(level.frame["time"].to_numpy(), level.frame["rss_db"].to_numpy(np.float64))
                log = file.sha256, mark
                airframe = searching_airframe(memory, placer.site.towers, log) if is_sounder_power(level) else None
                levels_on_track = placer.levels(level, self._floor_db(level), airframe)
                places[pci] = placer.propose(levels_on_track, taught(memory, log, loses_lock=False))
        for pci, place in places.items():
            if place is None:
                continue
            if place.tower is not None:
                self.towers[place.node] = place.tower, place.question
                self.sure |= {place.node} if place.radius_m <= _SURE_M else set()
            if pci is None:
                entry["node"] = place.node
                return f"  # {place.question}" if place.tower is None and place.question else ""
            entry["cells"][pci] = place.node
        return comment

    def _doubt(self, entry: Mapping[str, Any], levels: Sequence[Stream], placer: Placer) -> str:
        """Ask about a tower that a name gives and the levels contradict."""
        for level in levels:
            node = str(entry.get("node") or level.attributes.get("node"))
            better = placer.contradiction(placer.levels(level, self._floor_db(level)), node)
            if better is not None:
                return f"  # the name says {node}, the levels fit {better} far better: which tower?"
        return ""

    def _floor_db(self, level: Stream) -> float:
        if self.locks and is_sounder_power(level):
            return LOCK_FLOOR_DB
        floor = None if level.attributes.get("quantity") == "RSRP" else receiver_floor_db([level])
        return -np.inf if floor is None else floor

    def _offset_db(self, level: Stream, entry: Mapping[str, Any], placer: Placer) -> float | None:
        if level.kind != "rss":
            return None
        home = entry.get("cells", {}).get(_cell_of(level))
        node = home or entry.get("node") or level.attributes.get("node")
        return placer.offset_db(placer.levels(level, self._floor_db(level)), str(node))

    def _origin(self, streams: Sequence[Stream]) -> Origin | None:
        """Origin of relative times whose positions lie on the track of the flight."""
        if self.flown is None or not has_wall_clock(self.flown[1][0]):
            return None
        relative = [s for s in streams if s.attributes.get("clock") == "relative"]
        return next((origin for s in relative if (origin := origin_of(s, self.flown[0])) is not None), None)

    def _dated(self, stream: Stream, origin: Origin | None) -> Stream:
        """A stream at the times that the draft gives it: its levels belong where the track was then."""
        shift = self._shift(stream)
        if origin is not None and stream.attributes.get("clock") == "relative":
            shift += origin.time - np.datetime64(0, "ns")
        return replace(stream, frame=stream.frame.assign(time=stream.frame["time"] + shift)) if shift else stream

    def _refused(
        self, streams: Sequence[Stream], entry: Mapping[str, Any], shown: str, *, dated: bool
    ) -> dict[str, str]:
        """Streams that stay out, by name, and why; the others are taken.

        ``dated`` says that relative times have an origin now.
        """
        leading = _leading(streams)

        def reason(stream: Stream) -> str | None:
            span = stream_span(stream)
            if span is None:
                return "no samples"
            shift = self._shift(stream)
            span = span[0] + shift, span[1] + shift
            if stream.name in leading:
                return f"of the same receiver and cell as {leading[stream.name]}, which is compared"
            why = self._reason(stream, span, dated=dated)
            return why or (None if stream.kind == "telemetry" else self._enter_series(_key(stream, entry), span, shown))

        # the fuller of two ranks is entered first, and the other refused as its double
        ordered = sorted(streams, key=_missing)
        return {stream.name: why for stream in ordered if (why := reason(stream)) is not None}

    def _enter_series(self, key: tuple[str, ...], span: Span, shown: str) -> str | None:
        """Enter a series; the reason where one of that tower, channel and time is there already."""
        same = [source for when, source in self.entered.get(key, []) if meet(span, when)]
        if same:
            where = "another stream of the log" if same[0] == shown else same[0]
            return f"{where} has {key[1]} of that tower and time already"
        self.entered.setdefault(key, []).append((span, shown))
        return None

    def is_utc(self, file: IngestedFile) -> bool:
        """Check whether a log whose clock has no zone meets the telemetry as UTC, and not as local time."""
        return any(self._shift(stream) for stream in file.result.streams)

    def _shift(self, stream: Stream) -> np.timedelta64:
        """Time to be added to a clock in UTC that was read as local time; 0 of any other."""
        span = stream_span(stream)
        if self.flown is None or span is None or stream.kind == "telemetry":
            return np.timedelta64(0, "m")
        # an offset that the log itself writes is no guess of ours to mend
        trap = clock_trap(span, self.flown[1], self.options.timezone)
        written = stream.attributes.get("clock_from") == "written"
        hours = trap.hours if trap is not None and trap.is_utc and not written else 0.0
        return np.timedelta64(round(60 * hours), "m")

    def _reason(self, stream: Stream, span: Span, *, dated: bool) -> str | None:
        relative = not has_wall_clock(span[0])
        if stream.kind == "telemetry":
            if self.flown is None or stream is self.flown[0]:
                return None
            if relative and has_wall_clock(self.flown[1][0]):
                return "the track is that of other telemetry"
            return "the track is that of other telemetry" if meet(span, self.flown[1]) else _late(span, self.flown[1])
        if self.flown is None and self.positioned and not _has_positions(stream):
            return "it has no positions, and no telemetry is here"
        same_clock = self.flown is not None and not has_wall_clock(self.flown[1][0])  # the track counts as the log does
        if relative and not (dated or same_clock or _has_positions(stream)):
            return "its times are relative; read it again with --time-origin"
        if same_clock and not relative:
            return "the times of the track are relative; read it again with --time-origin"
        if self.flown is not None and not relative and not meet(span, self.flown[1]):
            return _late(span, self.flown[1], self.options.timezone)
        if self.has_level and is_own_radio(stream):
            return "the telemetry radio, beside levels of the experiment"
        return _RATIO if self.has_level and is_ratio(stream) else None


_RATIO = "a ratio to the noise, no level"


def _late(span: Span, flown: Span, timezone: str | None = None) -> str:
    trap = clock_trap(span, flown, timezone)
    shown = [" .. ".join(str(t.astype("datetime64[s]")).replace("T", " ") for t in s) for s in (span, flown)]
    return f"{shown[0]} is not at the time of the telemetry, {shown[1]} (UTC)" + (f": {trap.advice()}" if trap else "")


def _missing(stream: Stream) -> int:
    """Of two ranks of one modem, the one that was reported more often is taken: NR or LTE."""
    return int(stream.frame["rank"].isna().sum()) if stream.kind == "rank" else 0


def _leading(streams: Sequence[Stream]) -> dict[str, str]:
    """Streams that tell again what the RSRP of their receiver and cell tells, and the name of that RSRP."""
    leaders: dict[object, str] = {}
    same = {}
    # RSRP first: RSSI and wideband power of a cell hold its load and its neighbours
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
    """Key by which a report tells series apart."""
    tower = str(entry.get("node") or stream.attributes.get("node"))
    if stream.kind == "rank":
        return tower, "rank"
    return tower, str(entry.get("channel") or stream.channel)


def _top_m(stream: Stream) -> float:
    """Greatest height above take-off [m]; minus infinity where none is known."""
    if "altitude_m" not in stream.frame:
        return -np.inf
    return float(np.nanmax(stream.frame["altitude_m"].to_numpy(np.float64), initial=-np.inf))


def _has_positions(stream: Stream) -> bool:
    return stream.kind == "rank" and "latitude_deg" in stream.frame and bool(stream.frame["latitude_deg"].notna().any())


def _has_level(files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None) -> bool:
    """Check whether some stream of the flight is RSS in the proper sense."""
    proper = (s for file in files for s in file.result.streams if not is_own_radio(s))
    levels = [s for s in proper if s.kind == "rss" and not is_ratio(s)]
    spans = [span for s in levels if (span := stream_span(s))]
    return any(flown is None or meet(span, flown[1]) for span in spans)


def _samples(file: IngestedFile) -> int:
    return sum(len(s.frame) for s in file.result.streams if s.kind != "telemetry")


def _flown(files: Sequence[IngestedFile]) -> tuple[Stream, Span] | None:
    """The telemetry that most levels and ranks go with, first and last time; of equals, the longest."""
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

    # without any wall clock, a log that holds both levels and positions is a flight in its own time
    # the longest of equals: it gives a position to most samples
    return max(telemetry or relative[:1], key=worth, default=None)


# Telemetry of one aircraft, as its autopilot and another program write it, stays within this [m].
_ONE_VEHICLE_M = 30.0

# Log evidence a bin by which the levels must fit one vehicle better.
_SURE_OF_VEHICLE = 0.1


def _carrier(
    files: Sequence[IngestedFile], flown: tuple[Stream, Span] | None, site: Site
) -> tuple[tuple[Stream, Span] | None, str]:
    """Of several vehicles at the time of the flight, the one whose track the levels fit best at any tower; a question.

    Parameters
    ----------
    files : sequence of IngestedFile
    flown : (Stream, Span), optional
        Telemetry that the times of the logs choose.
    site : Site
    """
    if flown is None:
        return None, ""
    tracks = [flown]
    for stream in (s for file in files for s in file.result.streams if s.kind == "telemetry" and s is not flown[0]):
        span = stream_span(stream)
        if span is not None and meet(span, flown[1]) and _apart_m(stream, flown[0]) > _ONE_VEHICLE_M:
            tracks.append((stream, span))
    if len(tracks) == 1:
        return flown, ""
    levels = [s for file in files for s in file.result.streams if s.kind == "rss" and not is_ratio(s)]
    evidence = [max((Placer(site, s).evidence(level) for level in levels), default=-np.inf) for s, _ in tracks]
    order = np.argsort(evidence)
    # all must have evidence: a track without levels of its own says nothing against another
    sure = np.isfinite(evidence).all() and evidence[order[-1]] - evidence[order[-2]] > _SURE_OF_VEHICLE
    best = tracks[order[-1]] if sure else flown
    named = " and ".join(stream.name for stream, _ in tracks)
    apart = max(_apart_m(stream, flown[0]) for stream, _ in tracks[1:])
    fit = f", and the levels fit {best[0].name}" if sure else ""
    return best, f"{named} flew at this time, {apart:.0f} m apart{fit}: which carried the radio?"


def _apart_m(first: Stream, second: Stream) -> float:
    """Median distance of two tracks while both were logged [m]; 0 where that is not known."""
    (time, place), (at, other) = (positions_over_time(stream.frame) for stream in (first, second))
    if len(time) < 2 or len(at) < 2:
        return 0.0
    both = (time >= at[0]) & (time <= at[-1])
    flown = (place[both], interpolated(time[both], at, other))
    here, there = (rough_m(some[:, 0], some[:, 1], other[0]) for some in flown)
    return float(np.median(np.linalg.norm(here - there, axis=1))) if both.any() else 0.0


# Of a log's cells, those told most often are proposed; in a city a phone hears a hundred.
MOST_CELLS = 6


# Attributes that say whose level it is where no PCI does; channels, ports and antennas of one node are no cells.
_OF_CELL = re.compile(r"(cell|sector|[eg]nb|bs|base_station|e?ci|nci|[en]?cgi)(_.*)?")


def _cell_of(stream: Stream) -> int | str | None:
    """Key of a stream in ``cells:``: the PCI, else the stream's name where another number tells its cell."""
    if "pci" in stream.attributes:
        return int(stream.attributes["pci"])
    return stream.name if any(map(_OF_CELL.fullmatch, stream.attributes)) else None


def _cells(streams: Sequence[Stream]) -> list[int | str]:
    """Cells of a log of several, those with a twentieth of the samples of the first and more."""
    counts = {cell: len(s.frame) for s in streams if (cell := _cell_of(s)) is not None}
    most = max(counts.values(), default=0)
    most_sampled = sorted(counts, key=lambda cell: -counts[cell])[:MOST_CELLS]
    # numbers flush right are in their own order, and compare with names
    return sorted((cell for cell in most_sampled if 20 * counts[cell] >= most), key="{:>9}".format)


def _entry(file: IngestedFile, path: str, towers: Sequence[str]) -> tuple[dict[str, Any], str]:
    """Keys of a log and a question about what had to be guessed."""
    entry: dict[str, Any] = {"path": path, "reader": file.result.reader}
    need = [s for s in file.result.streams if s.kind in ("rss", "rank") and not s.attributes.get("node")]
    if not need:
        return entry, ""
    here = Path(file.path).resolve()
    # a home folder may be called after a tower, too
    near = named_tower("/".join(here.parts[-2:]), towers)  # of the file or its folder
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
    """The comment behind a line of ``logs:`` with one more question."""
    return f"{comment} {question}" if comment else f"  # {question}"


def _plain(entry: Mapping[str, Any]) -> str:
    """A mapping of plain names on one line."""
    # never wrapped: a question follows the entry on its line
    return str(yaml.safe_dump(dict(entry), default_flow_style=True, sort_keys=False, width=10_000)).strip()


def _flow(entry: dict[str, Any]) -> str:
    """A log's YAML mapping on one line, as a flight.yaml is read: a file may be called 1e6."""

    def dumped(style: str | None) -> str:
        text = yaml.safe_dump(
            entry, default_flow_style=True, sort_keys=False, width=10_000, allow_unicode=style is None,
            default_style=style,
        )  # fmt: skip
        return str(text).strip()

    text = dumped(None)
    try:
        # our reader follows YAML 1.2, the writer 1.1: a name such as 1e6 or 12:30 may come back as another
        as_read = len(text.splitlines()) == 1 and parse_yaml(text, LogSettings).path == entry["path"]
    except UsageError:
        as_read = False
    return text if as_read else dumped('"')


# Times before it are relative, or of a clock that was never set: no flight is called by them.
_FIRST_CLOCK = np.datetime64("1981")


def _name(flown: tuple[Stream, Span] | None, files: Sequence[IngestedFile]) -> str:
    """The time of take-off, else the log where it is one, else the folder."""
    if flown is None or flown[1][0] < _FIRST_CLOCK:
        place = Path(files[0].path).resolve()
        stem = place.stem if flown is not None and len(files) == 1 else place.parent.name
        # what flight.name allows
        return re.sub(r"[^A-Za-z0-9_.-]", "_", stem).lstrip("_.-") or "flight"
    return "flight_" + str(flown[1][0].astype("datetime64[m]")).replace("T", "_").replace(":", "")
