"""Calibrations of a site from flights, in the folder of its file: ``NAME.learned/learned.yaml`` and its tables.

Each entry is a campaign: learned antennas by tower and channel, their airframe, or a rank receiver. An entry contains
the band, the training logs (SHA-256), errors on held-out flights, the source of the flights and the command that learns
the entry again. Every table and every entry is verified by its SHA-256 when it is read.

There are three kinds of tables: the gain over the full sphere with its standard deviation (also as cuts for planning
tools), the gain towards both ends at once, and the directions in which a gain is known, with its covariance.
"""

from __future__ import annotations

import copy
import csv
import gzip
import hashlib
import json
import re
import zlib
from collections.abc import Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field

from ..common.content import marks, trained_on
from ..common.errors import InputError, UsageError, one_line, parsed, parsing
from ..common.files import LARGEST_TABLE, inside, locked, read_bounded, write_whole
from ..common.gaussian import Factor, gaussian_kernel
from ..common.geodesy import azimuth_rad, elevation_rad
from ..common.outputs import explained_os_errors, file_digest
from ..common.text import counted, guarded_comment
from ..common.units import FloatArray, db_from_power, power_from_db
from ..common.yamlfile import StrictModel, dump_yaml, load_yaml, parse_yaml
from .antennas import HIGHEST_DBI, MeasuredPattern, check_power

_INDEX = "learned.yaml"

# Relative difference of carriers up to which an antenna of a tower is used.
# The bands of Lake Wheeler at 3.3, 3.4 and 3.51 GHz differ by 3 % and have different antennas and gains.
BAND = 0.02

# Relative difference of carriers up to which an airframe is used. Its gains at 3.3 and 3.51 GHz share 90 % of their
# variance. There are no data for other bands.
AIRFRAME_BAND = 0.07


class Source(StrictModel):
    """The source of the flights, from calibration.yaml."""

    title: str = ""
    doi: str = ""
    licence: str = "not stated"
    airframe: str = "not stated"


class Errors(StrictModel):
    """Mean errors over held-out series: RMSE after one offset [dB], and the share inside 90 % intervals.

    ``rmse_db`` is the error on held-out flights. ``height_rmse_db``, ``sector_rmse_db`` and ``heading_rmse_db`` are the
    errors at heights, azimuth sectors of the tower and headings that are not in the training flights. ``heights_m`` are
    the cruise heights of the flights.

    Parameters
    ----------
    airframe_rmse_db : float, optional
        RMSE on the flights of this campaign, if only the gain of the airframe is used and was learned from other
        campaigns [dB].
    """

    series: int
    rmse_db: float
    rmse_4s_db: float
    free_space_rmse_db: float
    inside_90: float
    sector_rmse_db: float | None = None
    height_rmse_db: float | None = None
    heading_rmse_db: float | None = None
    airframe_rmse_db: float | None = None
    heights_m: list[float] = Field(default_factory=list)

    def expected(self, height_m: float, *, unseen: bool) -> tuple[Errors, str]:
        """Return the errors, with the RMSE for the kind of flight, and a text that names this kind.

        Parameters
        ----------
        height_m : float
            Cruise height; NaN if it is not known.
        unseen : bool
            True if most directions of the flight are not in the training flights.
        """
        new_height = bool(self.heights_m) and min(abs(height_m - h) for h in self.heights_m) > _SAME_HEIGHT_M
        kinds = (
            (unseen, self.sector_rmse_db, "in directions that were not flown"),
            (new_height, self.height_rmse_db, "at a height that was not flown"),
        )
        rmse_db, kind = next(
            ((value, kind) for is_so, value, kind in kinds if is_so and value is not None),
            (self.rmse_db, "on another flight"),
        )
        return self.model_copy(update={"rmse_db": rmse_db}), kind


# Flights count as flown at the same height if their cruise heights differ by less than this.
_SAME_HEIGHT_M = 5.0


class LearnedLock(StrictModel):
    """The lock probability of a receiver: P = 1 / (1 + exp(-per_db (path gain - gain_db))) [path gain in dB].

    Levels in lock have the mean ``locked_db`` at a path gain of ``gain_db``, and the SD ``locked_sd_db`` within a
    flight. Levels in lock increase by ``locked_per_db`` for each dB of path gain. This factor is less than 1, because a
    weak signal is in lock only if it is stronger than expected. The values that begin with ``lost`` describe levels
    without lock [unit of the measurement]. Three scores are means over held-out flights: the Brier score and the log
    score [nat], each for the model and for a constant share, and the RMSE of all samples if the floor replaces lower
    levels [dB].
    """

    gain_db: float
    per_db: Annotated[float, Field(gt=0)]
    share: Annotated[float, Field(gt=0, lt=1)]
    locked_db: float
    locked_per_db: float
    locked_sd_db: Annotated[float, Field(gt=0)]
    lost_db: float
    lost_per_db: float
    lost_sd_db: Annotated[float, Field(gt=0)]
    flights: int
    brier: float
    constant_brier: float
    log_score: float
    constant_log_score: float
    floor_db: float
    floor_rmse_db: float
    free_space_floor_rmse_db: float


class LearnedLevel(StrictModel):
    """The level of a log minus the free-space level for the stated power and gains [dB], with its SD."""

    offset_db: float
    sd_db: Annotated[float, Field(gt=0)]
    transmit_power_dbm: float
    unit: str


class LearnedSpread(StrictModel):
    """The error model of a level without the SD of the gain. See :class:`aerpaw_cmp.compare.gains.Spread`."""

    own_sd_db: Annotated[float, Field(ge=0)]
    noise_sd_db: Annotated[float, Field(ge=0)]
    fading_sd_db: Annotated[float, Field(ge=0)]
    fading_kurtosis: float
    bin_s: Annotated[float, Field(gt=0)]


class LearnedPair(StrictModel):
    """The gain towards both ends at once: its table, and the kernel that interpolates it.

    Parameters
    ----------
    sha256 : str, optional
        SHA-256 of the table, if no index contains it.
    """

    file: str
    sha256: str | None = None
    length: Annotated[float, Field(gt=0)]
    prior_sd_db: Annotated[float, Field(ge=0)]


class LearnedAntenna(StrictModel):
    """Properties of a learned antenna other than its table, as stored in a flight file or in calibrated.yaml.

    Parameters
    ----------
    sha256 : str
        SHA-256 of the table. A table with another SHA-256 is refused.
    command : str
        Command that learns the antenna again.
    """

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    command: str
    pair: LearnedPair | None = None
    spread: LearnedSpread


class LearnedHealth(StrictModel):
    """Errors of held-out flights of one channel, for comparison with a later flight.

    ``rmse_db`` is the mean over flights of the RMSE of 1-s means, with its SD. The error of 4-s means has two parts.
    ``slow_sd_db`` is correlated over a time and a length, and ``white_sd_db`` is not. The usual offset is in
    :class:`LearnedLevel`.

    Parameters
    ----------
    step_chi2 : float
        Largest chi-squared of a step of the level in these flights.
    channel_difference_sd_db : mapping of str to float
        For each other channel of the tower: SD over flights of the difference between the offsets of this channel and
        of the other channel.
    below_lock_share : float, optional
        Mean share of samples without lock. None if the receiver does not report its lock.
    run_s : float
        Typical duration of the longest run of equal levels [s].
    """

    flights: int
    rmse_db: Annotated[float, Field(gt=0)]
    rmse_sd_db: Annotated[float, Field(gt=0)]
    slow_sd_db: Annotated[float, Field(ge=0)]
    correlation_s: Annotated[float, Field(gt=0)]
    correlation_m: Annotated[float, Field(gt=0)]
    white_sd_db: Annotated[float, Field(ge=0)]
    step_chi2: float
    channel_difference_sd_db: dict[str, float] = Field(default_factory=dict)
    below_lock_share: float | None = None
    run_s: float

    @property
    def most_rmse_db(self) -> float:
        """RMSE that flights with intact equipment rarely exceed: mean + 2 SD [dB]."""
        return self.rmse_db + 2.0 * self.rmse_sd_db


class LearnedSeries(StrictModel):
    """The antennas of one tower and channel, and the properties of the levels of that channel.

    Parameters
    ----------
    channel : str
        Label of the antenna in the training flights. Other flights may use another label.
    receiver : str
        Receiver to which ``level`` and ``lock`` apply, as named by ``receiver`` in a flight file. Empty if not named.
    known_file : str
        Name of the table of directions at the UAV in which its gain is known, with the covariance of the gain.
    tower_known_file : str
        Name of the table of directions at the tower in which its antenna gain is known, with the covariance.
    sd_db : float
        Mean standard deviation of the level over flown directions.
    shares_airframe : bool
        False if the gain of the UAV does not predict held-out flights of its campaign. The gain is then used only for
        this campaign.
    level : LearnedLevel, optional
        Level above free space. For receivers that can lose their lock, only levels in lock are used.
    """

    tower: str
    channel: str
    receiver: str = ""
    carrier_hz: float
    tower_file: str
    uav_file: str
    known_file: str
    tower_known_file: str
    pair: LearnedPair | None = None
    spread: LearnedSpread
    sd_db: float
    shares_airframe: bool = True
    lock: LearnedLock | None = None
    level: LearnedLevel | None = None
    health: LearnedHealth | None = None

    @property
    def files(self) -> list[str]:
        """Names of the tables."""
        both = [] if self.pair is None else [self.pair.file]
        return [self.tower_file, self.uav_file, self.known_file, self.tower_known_file, *both]


class LearnedReceiver(StrictModel):
    """A rank receiver of one tower, with its scores on held-out flights and the log score of a constant forecast.

    Parameters
    ----------
    quantity : str
        Rank from which the receiver was learned, such as ``scheduled PDSCH rank``. No calculation uses this text.
    """

    tower: str
    quantity: str
    carrier_hz: float
    file: str
    kappa: float | None = None
    log_score: float | None = None
    constant_log_score: float | None = None


class Entry(StrictModel):
    """The antennas and receivers of one campaign, as learned by one run of the calibration.

    Parameters
    ----------
    joined : list of str
        Other campaigns whose flights also determine the gain of the UAV.
    trained_on : list of str
        SHA-256 of all logs of the calibration.
    tables : mapping of str to str
        SHA-256 of the tables as written. Only files with these digests are replaced or removed.
    sha256 : str
        SHA-256 of all other values of the entry.
    """

    command: str
    made: str
    flights: list[str]
    flown: list[str]
    joined: list[str] = Field(default_factory=list)
    trained_on: list[Annotated[str, Field(pattern="^[0-9a-f]{64}$")]]
    source: Source = Source()
    errors: Errors | None = None
    series: list[LearnedSeries] = Field(default_factory=list)
    receivers: list[LearnedReceiver] = Field(default_factory=list)
    tables: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)
    sha256: str = ""

    @property
    def digest(self) -> str:
        """Return the SHA-256 of the values without ``sha256``."""
        return _digest(self.model_dump(mode="json", exclude_none=True))

    def about(self, errors: Errors | None = None, kind: str = "on another flight") -> str:
        """Return a sentence about the training flights and the expected error (default: held-out flights)."""
        errors = errors or self.errors
        days = f" of {', '.join(self.flown)}" if self.flown else ""  # logs with relative times have no date
        text = f"learned on {counted(len(self.flights), 'flight')}{days}"
        text += f", the UAV also on {', '.join(self.joined)}" if self.joined else ""
        if errors is not None:
            text += f"; expect an RMSE of {errors.rmse_db:.1f} dB {kind}, free space {errors.free_space_rmse_db:.1f} dB"
        for lock in [item.lock for item in self.series if item.lock is not None][:1]:
            text += (
                f", {lock.floor_rmse_db:.1f} and {lock.free_space_floor_rmse_db:.1f} dB where levels below "
                f"{lock.floor_db:g} count as {lock.floor_db:g}"
            )
        kappas = [receiver.kappa for receiver in self.receivers if receiver.kappa is not None]
        return text + (f"; expect kappa {sum(kappas) / len(kappas):.2f} of ranks on another flight" if kappas else "")


_Name = Annotated[str, Field(pattern="^[A-Za-z0-9][A-Za-z0-9_.-]*$")]


class Learned(StrictModel):
    """All learned models of a site, by name. The list ``names`` shows if an entry of the file is missing."""

    format: Literal["aerpaw-cmp learned 3"] = "aerpaw-cmp learned 3"
    names: list[_Name] = Field(default_factory=list)
    entries: dict[_Name, Entry] = Field(default_factory=dict)


def folder_of(site: str | Path) -> Path:
    """Return the folder of the learned models of a site, next to its file or in the package."""
    path = Path(site)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path.with_suffix(".learned")
    name = str(site).lower().replace("-", "_").replace(" ", "_")
    return Path(str(resources.files("aerpaw_cmp.site") / "data" / f"{name}.learned"))


def read_learned(site: str | Path) -> Learned:
    """Read the learned models of a site. The result is empty if the site has none.

    Raises
    ------
    UsageError
        If the index is damaged, has another version, or was edited.
    InputError
        If the index names a file outside its folder.
    """
    folder = folder_of(site)
    stored, lost, damage = readable_index(folder)
    if damage is not None:
        again = "; ".join(lost.values()) or "aerpaw-cmp calibrate CALIBRATION.yaml --into-site SITE"
        wanted = f"an index as calibrate writes it; learn it again: {again}"
        raise UsageError(damage.found, expected=wanted, cause="a damaged file", path=damage.path, line=damage.line)
    for name, entry in stored.entries.items():
        if entry.sha256 != entry.digest:
            raise UsageError(
                f"the values of {name!r} are not those that were written (SHA-256)",
                expected=f"an entry as calibrate writes it; learn it again: {entry.command}",
                cause="an edited value",
                path=folder / _INDEX,
            )
    return stored


def readable_index(folder: Path) -> tuple[Learned, dict[str, str], UsageError | None]:
    """Read the index in a folder of learned models, even if it is damaged or values of an entry were edited.

    Returns
    -------
    Learned
        The index without unreadable entries.
    dict of str to str
        The commands that learn the unreadable entries again, by name of the entry.
    UsageError or None
        Error that describes the damage, or None if the index is intact.

    Raises
    ------
    UsageError
        If the index or an entry has another version.
    InputError
        If the index names a file outside its folder.
    """
    index, lost, damage = inside(folder, _INDEX, folder / _INDEX), dict[str, str](), None
    try:
        stored = load_yaml(index, Learned) if index.is_file() else Learned()
        if stored.names != [*stored.entries]:
            raise UsageError(f"names {', '.join(stored.names)}, but entries {', '.join(stored.entries)}", path=index)
    except UsageError as error:
        damage, stored = error, Learned()
        text = read_bounded(index, LARGEST_TABLE, "an index").decode("utf-8", "replace")
        if re.search(rf"^format: (?!{stored.format}\s*$)", text, re.M):
            raise
        for block in re.split(r"^(?=  [A-Za-z0-9][\w.-]*:\s*$)", text, flags=re.M)[1:]:
            name = block.split(":")[0].strip()
            entry = _entry_of(block, name, error)
            if isinstance(entry, str):
                lost[name] = entry
            else:
                stored.entries[name] = entry
        names = {*re.findall(r"[\w.-]+", "".join(re.findall(r"^names: \[([^]]*)", text, re.M)))}
        lost |= {name: f"the calibration of {name}" for name in sorted(names - {*stored.entries, *lost})}
    for name in {name for entry in stored.entries.values() for name in (*files_of(entry), *entry.tables)}:
        # check before a file is opened, because an index may be untrusted
        inside(folder, name, index, plain=True)
    return stored, lost, damage


def damage_remark(folder: Path, learning: Container[str]) -> list[str]:
    """Return a sentence about a damaged index that is rewritten when the entries ``learning`` are learned."""
    _, lost, damage = readable_index(folder)
    if damage is None:
        return []
    again = [f"{name} ({command})" for name, command in lost.items() if name not in learning]
    text = f"{damage.path} was damaged and is written again; its damaged content is kept in {damaged_copy(folder).name}"
    return [text + (f"; learn again: {', '.join(again)}" if again else "")]


def damaged_copy(folder: Path) -> Path:
    """Return the path for a copy of a damaged index. The name contains its digest, so no other copy is replaced."""
    return folder / f"learned.damaged-{file_digest(folder / _INDEX)[:12]}.yaml"


class _AnyEntries(BaseModel):
    """The entries of an index of any version."""

    entries: dict[str, dict[str, Any]]


def _entry_of(block: str, name: str, damage: UsageError) -> Entry | str:
    """Return the entry in its lines of an index, or the command that learns it again if these lines are damaged.

    Raise ``damage`` if another version of this program wrote the lines.
    """
    text, values = f"entries:\n{block}", dict[str, Any]()
    with suppress(UsageError):
        return parse_yaml(text, Learned).entries[name]
    with suppress(UsageError):
        values = parse_yaml(text, _AnyEntries).entries[name]
    if values.get("sha256") == _digest(values):
        raise damage
    command = re.search(r"^    command: (.+(\n      .+)*)$", block, re.M)
    return " ".join(command[1].split()) if command else f"the calibration of {name}"


def _digest(values: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the values of an entry without ``sha256``."""
    known = {key: value for key, value in values.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()


def store_entry(site: str | Path, name: str, entry: Entry, files: Mapping[str, bytes]) -> list[Path]:
    """Write an entry and its tables into the learned models of a site, with the index last.

    Parameters
    ----------
    site : str or Path
    name : str
        Name of the entry. An existing entry of this name is replaced.
    entry : Entry
    files : mapping of str to bytes
        Content of the tables before compression, by name with the ending ``.gz``.

    Returns
    -------
    list of Path

    Raises
    ------
    UsageError
        If a file with the name of a table was not written by a calibration, or the index is damaged.
    InputError, OutputError
        The same as in :func:`read_learned`, or if the folder cannot be written.
    """
    folder = folder_of(site)
    # with mtime=0, equal content has equal bytes and the same SHA-256
    packed = {file: gzip.compress(content, 9, mtime=0) for file, content in files.items()}
    tables = {file: hashlib.sha256(content).hexdigest() for file, content in packed.items()}
    with explained_os_errors(folder):
        folder.mkdir(exist_ok=True)
        # if two calibrations of one site run at once, neither may overwrite the entry of the other
        with locked(folder):
            stored, _, damage = readable_index(folder)
            if damage is not None:
                write_whole(damaged_copy(folder), (folder / _INDEX).read_bytes())
            # replace only files of calibrations: files with a digest in an entry, edited tables, and tables of a killed
            # run
            written = {item for known in stored.entries.values() for item in known.tables.items()}
            for file in packed:
                place = inside(folder, file, folder / _INDEX, plain=True)
                known = {*written, *tables.items()}
                if place.exists() and (file, file_digest(place)) not in known and not _is_table(place):
                    raise UsageError(
                        "no calibration wrote this file",
                        expected="another 'calibration:' name, or no file of this name in the folder",
                        path=place,
                    )
            for file, content in packed.items():
                write_whole(folder / file, content)
            made = entry.model_copy(update={"tables": tables})
            made = made.model_copy(update={"sha256": made.digest})
            entries = dict(sorted({**stored.entries, name: made}.items()))
            stored = Learned(names=list(entries), entries=entries)
            # write the index after the tables, so that every entry has its files
            write_whole(folder / _INDEX, dump_yaml(stored.model_dump(mode="json", exclude_none=True)))
            used = {file for known in entries.values() for file in files_of(known)}
            for file, digest in sorted(written):
                # do not remove a table that a user has changed
                if file not in used and (folder / file).is_file() and file_digest(folder / file) == digest:
                    (folder / file).unlink()
    return [folder / _INDEX, *(folder / file for file in files)]


def copy_learned(base: str | Path, site: Path) -> list[str]:
    """Copy the learned models of a base site next to a new site, and return a line that says so."""
    origin, folder = folder_of(base), folder_of(site)
    if not origin.is_dir() or (folder / _INDEX).exists():
        return []
    entries = read_learned(base).entries
    with explained_os_errors(folder):
        folder.mkdir(exist_ok=True)
        # copy the index last, because without it the new site has no learned models
        for name in [*sorted(set().union(*map(files_of, entries.values()))), _INDEX]:
            place = inside(origin, name, origin / _INDEX, plain=True)
            if place.is_file() and not (folder / name).exists():
                write_whole(folder / name, place.read_bytes())
    return [f"learned antennas and receivers of the base were copied to {folder.name}: {', '.join(entries)}"]


def learned_lines(site: str | Path) -> list[str]:
    """Return lines about the learned models of a site."""
    lines = []
    for name, entry in read_learned(site).entries.items():
        what = [f"{s.tower}.{s.channel} at {s.carrier_hz / 1e9:g} GHz (SD {s.sd_db:.1f} dB)" for s in entry.series]
        what += [f"rank receiver at {r.tower}" for r in entry.receivers]
        source = ", ".join(part for part in (entry.source.title, entry.source.doi, entry.source.licence) if part)
        lines.append(f"{name}: {', '.join(what)}; {entry.about()}; airframe: {entry.source.airframe}")
        lines.append(
            f"  source: {source}; {counted(len(entry.trained_on), 'log')}, SHA-256 in {folder_of(site).name}/{_INDEX}"
        )
        lines.append(f"  made {entry.made} by: {entry.command}")
    return lines


def files_of(entry: Entry) -> set[str]:
    """Return the names of the tables of an entry."""
    return {file for s in entry.series for file in s.files} | {r.file for r in entry.receivers}


# Start of the comment that names the calibration and, after ``, from``, its flights.
LEARNED = "# aerpaw-cmp calibrate: "


def _is_table(place: Path) -> bool:
    """Check whether a file is a table of a calibration or a rank receiver, even if it is truncated."""
    with suppress(InputError, OSError, zlib.error):
        content = read_bounded(place, LARGEST_TABLE, "a table")
        if content.startswith(b"\x1f\x8b"):
            content = zlib.decompressobj(wbits=31).decompress(content, LARGEST_TABLE)
        written = content.startswith(LEARNED.encode()) or (content.startswith(b"{") and b'"trained_on"' in content)
        return written or not content
    return False


@dataclass(frozen=True, slots=True)
class Written:
    """The SHA-256 of a file as a calibration wrote it, and the command that writes it again."""

    sha256: str
    command: str


def read_table(path: Path, expected: str, written: Written | None = None) -> bytes:
    """Return the content of a table, compressed or not.

    Parameters
    ----------
    path : Path
    expected : str
        Kind of the table, for messages.
    written : Written, optional
        The table must have this SHA-256.

    Raises
    ------
    OSError
    InputError
        If the file is too large or damaged, or has changed since it was written.
    """
    missing = written is not None and not path.exists()
    content = b"" if missing else read_bounded(path, LARGEST_TABLE, expected)
    if written is not None and hashlib.sha256(content).hexdigest() != written.sha256:
        found = "is missing" if missing else "is not the one that was learned"
        copied = f"settings that were copied without the folder {one_line(path.parent.name)}"
        raise InputError(
            f"this table {found} (SHA-256 {written.sha256[:12]}...)",
            expected=f"{expected} as it was written; learn it again: {written.command}",
            cause=copied if missing else "an edited table, or a calibration that was killed while it wrote",
            path=path,
        )
    if not content.startswith(b"\x1f\x8b"):
        return content
    with parsing(path, expected, "a cut copy"), gzip.open(path) as book:
        # read one byte more than allowed, which shows that a table is too large without decompressing all of it
        unpacked = book.read(LARGEST_TABLE + 1)
    if len(unpacked) > LARGEST_TABLE:
        raise InputError(f"it unpacks to more than {LARGEST_TABLE} bytes", expected=expected, path=path)
    return unpacked


class Named(StrictModel):
    """An entry by name, such as ``lake_wheeler/dataset12_uav``, and its part: ``uav``, ``TOWER.CHANNEL`` or all."""

    entry: Entry
    part: str
    folder: Path

    def antenna(self, end: str, carrier_hz: float) -> LearnedSeries | None:
        """Return the series whose antenna fits an end (``uav``, ``tower``) of a link, or None."""
        if end == "tower":
            return next((s for s in self.entry.series if f"{s.tower}.{s.channel}" == self.part), None)
        # all channels of a band share the antenna of the airframe
        return min(self.entry.series, key=lambda s: abs(s.carrier_hz / carrier_hz - 1.0), default=None)

    def written(self, file: str) -> Written:
        """Return the SHA-256 of a table of the entry, and the command that writes it."""
        return Written(self.entry.tables[file], self.entry.command)


class UnknownName(UsageError):  # noqa: N818  # a special case of UsageError
    """The error for a name that no learned model has."""


def find_named(name: str, folder: Path, end: str = "") -> Named:
    """Return the entry of a name ``SITE/ENTRY``, ``SITE/ENTRY_uav`` or ``SITE/ENTRY_TOWER.CHANNEL``.

    Parameters
    ----------
    name : str
    folder : Path
        Folder of sites that are not packaged, with SITE.learned.
    end : {"uav", "tower", "receiver", ""}
        Required part: the airframe, the antenna of a tower, a rank receiver, or any part.

    Raises
    ------
    UnknownName
        If there is no such site, entry or part, or the part is for another end.
    UsageError
        If the learned models cannot be read.
    """
    site, _, entry_part = name.rpartition("/")
    # prefer a site next to the flight file to a packaged site; use an absolute path, which is valid in any working
    # folder
    place: str | Path = folder.absolute() / f"{site}.yaml"
    packaged = folder_of(site)
    if not folder_of(place).is_dir() and packaged.is_absolute() and packaged.is_dir():
        place = site
    fitting = []
    for entry_name, entry in read_learned(place).entries.items():
        for part, full in _parts(entry_name, entry, end).items():
            if full == entry_part:
                return Named(entry=entry, part=part, folder=folder_of(place))
            fitting.append(f"{site}/{full}")
    raise UnknownName(
        f"no learned model is called {name!r}" + (f" for {_WANTED[end]}" if end else ""),
        expected="one of " + ", ".join(fitting) if fitting else "SITE/ENTRY of a site with learned models",
        cause=None if fitting else f"no models in {folder_of(place)}: SITE is relative to the flight file (../my_site)",
    )


_WANTED = {"uav": "the UAV", "tower": "a tower", "receiver": "the rank receiver"}


def _parts(name: str, entry: Entry, end: str) -> dict[str, str]:
    """Return the full names of the antennas and receivers of an entry that can be used at an end, by short name."""
    parts = {"": name} if end in ("", "receiver") and (not end or entry.receivers) else {}
    if end in ("", "uav") and entry.series:
        parts["uav"] = f"{name}_uav"
    if end in ("", "tower"):
        parts |= {f"{s.tower}.{s.channel}": f"{name}_{s.tower}.{s.channel}" for s in entry.series}
    return parts


# Variance of the rounding errors of known values, as a share of the process variance. The table has gains to 0.01 dB
# and angles to 0.1 deg, so the gains of close directions may contradict each other.
_NUGGET = 1e-3


@dataclass(frozen=True, kw_only=True)
class PairGain:
    """A Gaussian process over the directions at both ends, with known values at some of them.

    Parameters
    ----------
    directions : (k, 6)
        Unit vectors from the UAV to the tower in the body frame, and from the tower to the UAV in the frame of the
        mast.
    gain_db : (k,)
        Part of the gain that the antennas of both ends do not explain separately [dB].
    sd_db : (k,)
        Standard deviation of the level predicted by both antennas and this gain [dB].
    length : float
        Length of the Gaussian kernel of the chord.
    prior_sd_db : float
        Standard deviation of the gain far from known directions [dB].
    """

    directions: FloatArray
    gain_db: FloatArray
    sd_db: FloatArray
    length: float
    prior_sd_db: float

    @cached_property
    def _factor(self) -> Factor:
        matrix = gaussian_kernel(self.directions, self.directions, self.length)
        # without this term, repeated directions would make the matrix singular
        matrix[np.diag_indices(len(matrix))] += _NUGGET
        return Factor.of(matrix)

    def at(self, directions: FloatArray, apart_sd_db: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gain and standard deviation of the level towards directions (n, 6), each (n,) [dB].

        Parameters
        ----------
        directions : (n, 6)
            Directions, as in the parameter ``directions`` of the class.
        apart_sd_db : (n,)
            Joint standard deviation of the gains of both antennas, if each is learned separately [dB].

        Returns
        -------
        gain_db, sd_db : (n,)

        Notes
        -----
        The variance is a weighted mean. One term is the variance in the table near the direction, and the other is the
        sum of the variances of antennas and prior. The weight of the first term is the share of the process variance
        that the known directions determine.
        """
        gain, sd = np.empty(len(directions)), np.empty(len(directions))
        white = self._factor.whiten(self.gain_db)
        # use batches, because the kernel with all known directions needs much memory
        for start in range(0, len(directions), 4096):
            part = slice(start, start + 4096)
            across = gaussian_kernel(directions[part], self.directions, self.length)
            gain[part], known = self._factor.condition(across, white)
            # due to rounding, the explained share of the variance can exceed 1 at a known direction
            known = np.minimum(known, 1.0)
            near = across @ self.sd_db**2 / np.maximum(across.sum(axis=1), 1e-12)
            away = apart_sd_db[part] ** 2 + self.prior_sd_db**2
            sd[part] = np.sqrt(known * near + (1.0 - known) * away)
        return gain, sd

    def table(self, notes: Sequence[str]) -> str:
        """Return the content of a table of the directions, gains and standard deviations, with comments at its head."""
        angles = np.concatenate([angles_of(self.directions[:, :3]), angles_of(self.directions[:, 3:])], axis=1)
        rows = np.column_stack([angles, self.gain_db, self.sd_db])
        lines = (f"{a:.1f},{b:.1f},{c:.1f},{d:.1f},{g:.2f},{s:.2f}" for a, b, c, d, g, s in rows)
        return _table(notes, PAIR_COLUMNS, lines)


PAIR_COLUMNS = ("uav_azimuth_deg", "uav_elevation_deg", "tower_azimuth_deg", "tower_elevation_deg", "gain_db", "sd_db")


@parsed("a table of the gain towards both ends")
def read_pair(path: Path, length: float, prior_sd_db: float, written: Written | None = None) -> PairGain:
    """Read a table of :meth:`PairGain.table`.

    Parameters
    ----------
    path : Path
    length, prior_sd_db : float
        Kernel of the gain, as in :class:`PairGain`.
    written : Written, optional
        The table must have this SHA-256.

    Returns
    -------
    PairGain

    Raises
    ------
    InputError
        If the columns are wrong, there are no rows, a value is not finite, or the table has changed since it was
        written.
    """
    rows = _numbers(path, "a table of the gain towards both ends", PAIR_COLUMNS, written)
    if any(len(row) != len(PAIR_COLUMNS) for row in rows):
        raise InputError("rows of another length", expected=", ".join(PAIR_COLUMNS), path=path)
    table = np.array(rows)
    return PairGain(
        directions=np.concatenate([vectors_of(table[:, :2]), vectors_of(table[:, 2:4])], axis=1),
        gain_db=table[:, 4],
        sd_db=table[:, 5],
        length=length,
        prior_sd_db=prior_sd_db,
    )


def _numbers(path: Path, what: str, columns: Sequence[str], written: Written | None) -> list[list[float]]:
    """Return the rows of a table. Raise InputError for other columns, no rows, or values that are not finite."""
    text = read_table(path, what, written).decode("utf-8-sig")
    lines = [line for line in text.splitlines() if line.strip() and line[0] != "#"]
    rows = [[float(cell) for cell in line.split(",")] for line in lines[1:]]
    if lines[:1] != [",".join(columns)] or not rows:
        raise InputError("wrong columns, or no rows", expected=", ".join(columns), path=path)
    if not np.isfinite(np.concatenate(rows)).all():
        raise InputError("values that are not finite", expected="numbers: " + ", ".join(columns), path=path)
    return rows


def angles_of(vectors: FloatArray) -> FloatArray:
    """Return azimuths and elevations (n, 2) [deg] of unit vectors (n, 3)."""
    return np.column_stack([np.degrees(azimuth_rad(vectors)) % 360.0, np.degrees(elevation_rad(vectors))])


def vectors_of(angles_deg: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) of azimuths and elevations (n, 2) [deg]."""
    azimuth, elevation = np.radians(angles_deg).T
    across = np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


SPHERE_COLUMNS = ("azimuth_deg", "elevation_deg", "gain_dbi", "gain_sd_db")


class SpherePattern(MeasuredPattern):
    """A gain grid with its standard deviation.

    Parameters
    ----------
    name : str
    gain_dbi, sd_db : (thetas, phis)
        Zenith angle 0 to 180 deg and azimuth 0 to below 360 deg, both equally spaced.
    notes : str
        Comments of the file, which contain the training logs.

    Attributes
    ----------
    pair : PairGain or None
        Gain towards both ends at once, in addition to the gain of the tower's antenna.
    spread : LearnedSpread or None
        Error model of a level without the SD of the gain.
    """

    def __init__(
        self, name: str, gain_dbi: FloatArray, sd_db: FloatArray, frequency_hz: float | None = None, notes: str = ""
    ) -> None:
        super().__init__(name, np.sqrt(power_from_db(gain_dbi)).astype(np.complex128), None, frequency_hz)
        self.trained_on, self.marks = trained_on(notes), marks(notes)
        self.notes = notes
        self.pair: PairGain | None = None
        self.spread: LearnedSpread | None = None
        self._sd_db = np.asarray(sd_db, dtype=np.float64)

    @property
    def largest_sd_db(self) -> float:
        """Largest standard deviation of the gain over all directions [dB]."""
        return float(self._sd_db.max())

    def gain_sd_db(self, theta_rad: FloatArray, phi_rad: FloatArray) -> FloatArray:
        """Return the standard deviation of the gain towards directions [dB], bilinear."""
        from scipy.ndimage import map_coordinates

        theta, phi = np.broadcast_arrays(np.asarray(theta_rad, dtype=float), np.asarray(phi_rad, dtype=float))
        rows, columns = self._sd_db.shape
        # repeat the first meridian after the last, so that interpolation is periodic
        wrapped = np.concatenate([self._sd_db, self._sd_db[:, :1]], axis=1)
        at = [theta.ravel() / np.pi * (rows - 1), (phi.ravel() % (2 * np.pi)) / (2 * np.pi) * columns]
        return np.asarray(map_coordinates(wrapped, at, order=1, mode="nearest").reshape(theta.shape))


def sphere_grid(step_deg: float = 5.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return zenith angles (t,) and azimuths (p,) [deg] of a full sphere, and unit vectors (t, p, 3)."""
    # include both poles, but not 360 deg, which is equal to 0
    theta, phi = np.arange(0.0, 180.0 + step_deg / 2, step_deg), np.arange(0.0, 360.0, step_deg)
    t, p = np.radians(theta)[:, None], np.radians(phi)[None, :]
    vectors = np.stack(np.broadcast_arrays(np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)), axis=-1)
    return theta, phi, vectors


def unit_mean_gain(gain_db: FloatArray) -> FloatArray:
    """Return a grid (thetas, phis) [dB] whose mean power over the sphere is equal to an isotropic antenna.

    The mean of a learned gain is not determined, because it cannot be separated from the offset.
    """
    theta = np.linspace(0.0, np.pi, gain_db.shape[0])
    # weight by the area of a ring, which is zero at a pole
    weight = np.sin(theta)[:, None] * np.ones_like(gain_db)
    return np.asarray(gain_db - db_from_power((power_from_db(gain_db) * weight).sum() / weight.sum()))


def sphere_csv(gain_dbi: FloatArray, sd_db: FloatArray, notes: tuple[str, ...] = (), decimals: int = 3) -> str:
    """Return the text of an antenna file: comment lines, a header, and a line per direction.

    Parameters
    ----------
    gain_dbi, sd_db : (thetas, phis)
        Zenith angle 0 to 180 deg and azimuth 0 to below 360 deg, both equally spaced.
    notes : tuple of str
        Comment lines.
    decimals : int
        Decimals of the gains.

    Returns
    -------
    str
    """
    rows, columns = gain_dbi.shape
    theta, phi = np.linspace(0.0, 180.0, rows), np.arange(columns) * (360.0 / columns)
    lines = (
        f"{phi[j]:g},{90.0 - theta[i]:g},{gain_dbi[i, j]:.{decimals}f},{sd_db[i, j]:.{decimals}f}"
        for i, j in np.ndindex(rows, columns)
    )
    return _table(notes, SPHERE_COLUMNS, lines)


def _table(notes: Sequence[str], columns: Sequence[str], lines: Iterable[str]) -> str:
    """Return a CSV table with comments above its header."""
    return "\n".join([*(guarded_comment(f"# {note}") for note in notes), ",".join(columns), *lines, ""])


@parsed("a table of gain over direction")
def read_sphere_csv(path: str | Path, written: Written | None = None) -> SpherePattern:
    """Read an antenna file of :func:`sphere_csv`.

    Azimuth is counter-clockwise from the x axis of the device, and positive elevation is upwards.

    Parameters
    ----------
    path : str or Path
    written : Written, optional
        The file must have this SHA-256.

    Raises
    ------
    InputError
        If columns or directions are missing, a value is not a gain, or the file has changed since it was written.
    """
    path = Path(path)
    # return a copy, because the pattern is cached, but ``pair`` and ``spread`` belong to one use of it
    return copy.copy(_pattern_of(read_table(path, "an antenna file", written).decode("utf-8-sig"), path))


@lru_cache(maxsize=64)
def _pattern_of(text: str, path: Path) -> SpherePattern:
    """Return the antenna in the text of a file. It is cached, because each draft reads all models of a site."""
    numbered = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and line[0] != "#"]
    header = [cell.strip() for cell in numbered[0][1].split(",")] if numbered else []
    if header[:3] != list(SPHERE_COLUMNS[:3]):
        raise InputError(
            f"the columns are {', '.join(header) or 'none'}",
            expected=", ".join(SPHERE_COLUMNS),
            path=path,
            line=numbered[0][0] if numbered else None,
        )
    values = _values(numbered[1:], len(header), path) if numbered[1:] else np.empty((0, len(header)))
    azimuth, elevation = np.unique(np.round(values[:, 0] % 360.0, 6)), np.unique(np.round(values[:, 1], 6))[::-1]
    _check_grid(azimuth, elevation, len(values), path)
    row = np.argmin(np.abs(elevation[None, :] - values[:, 1:2]), axis=1)
    column = np.argmin(np.abs(azimuth[None, :] - values[:, :1] % 360.0), axis=1)
    # the number of rows is right, so a repeated direction means that another direction is missing
    if len(np.unique(row * len(azimuth) + column)) != len(values):
        raise InputError("a direction is given twice", expected="each direction once", path=path)
    gain, sd = np.zeros((2, len(elevation), len(azimuth)))
    gain[row, column] = values[:, 2]
    if len(header) > 3:
        sd[row, column] = values[:, 3]
    notes = "\n".join(line for line in text.splitlines() if line.startswith("#"))
    # reports use the name of the file for the antenna
    pattern = SpherePattern(path.stem, gain, sd, notes=notes)
    check_power(pattern)
    return pattern


def _values(numbered: Sequence[tuple[int, str]], width: int, path: Path) -> FloatArray:
    """Return the numbers (n, width) of numbered lines. Raise InputError at the first line that is not a direction."""
    with suppress(ValueError):
        values = np.loadtxt([line for _, line in numbered], delimiter=",", comments=None, ndmin=2)
        if values.shape == (len(numbered), width) and _is_gain(values.T):
            return values
    # slower, but this finds the damaged line
    return np.array([_row(line, number, width, path) for number, line in numbered]).reshape(-1, width)


def _is_gain(columns: FloatArray) -> bool:
    """Check whether the columns (azimuth, elevation, gain and perhaps standard deviation) have possible values."""
    return bool(np.isfinite(columns).all() and (columns[2] <= HIGHEST_DBI).all() and (columns[3:4] >= 0.0).all())


def _row(line: str, number: int, width: int, path: Path) -> list[float]:
    """Return the numbers of a line. Raise InputError if they are not a direction with its gain."""
    cells = next(csv.reader([line]))
    with suppress(ValueError):
        row = [float(cell) for cell in cells]
        if len(row) == width and _is_gain(np.array(row)):
            return row
    raise InputError(
        f"'{line[:60]}'",
        expected=f"{width} numbers: angles in degrees, gain in dBi (at most {HIGHEST_DBI:g}), standard deviation",
        cause="the line was cut off" if len(cells) < width else None,
        path=path,
        line=number,
    )


def _check_grid(azimuth: FloatArray, elevation: FloatArray, count: int, path: Path) -> None:
    is_sphere = (
        len(azimuth) >= 4
        and len(azimuth) % 2 == 0
        and len(elevation) >= 3
        and np.allclose(azimuth, np.arange(len(azimuth)) * 360.0 / len(azimuth), atol=1e-3)
        and np.allclose(elevation, np.linspace(90.0, -90.0, len(elevation)), atol=1e-3)
    )
    if not is_sphere or count != len(azimuth) * len(elevation):
        raise InputError(
            f"{count} directions of {len(azimuth)} azimuths and {len(elevation)} elevations",
            expected="a full sphere: azimuth from 0 deg and elevation from 90 to -90 deg in equal steps, each once",
            cause="lines are missing",
            path=path,
        )


def planning_cuts(pattern: MeasuredPattern, name: str, carrier_hz: float, notes: Sequence[str] = ()) -> str:
    """Return comments and the two principal cuts as MSI Planet text: attenuation below the peak, 360 lines each.

    Angles of the cut HORIZONTAL increase clockwise as seen from above, as in planning tools. The cut VERTICAL begins at
    the horizon in front, and its angles increase downwards.

    Parameters
    ----------
    pattern : MeasuredPattern
    name : str
        Name of the antenna.
    carrier_hz : float
    notes : sequence of str
        Text of COMMENT lines.

    Returns
    -------
    str
        Text that ends with a line end.
    """
    degrees = np.radians(np.arange(360.0))
    # the sign is negative, because HORIZONTAL runs clockwise
    level = pattern.gain_dbi(np.full(360, np.pi / 2), -degrees)
    below = np.pi / 2 + degrees  # zenith angle on the great circle through the boresight
    over = pattern.gain_dbi(below, np.zeros(360))
    peak = max(float(level.max()), float(over.max()))
    lines = [f"NAME {name}", f"FREQUENCY {carrier_hz / 1e6:g}", f"GAIN {peak:.2f} dBi"]
    lines += [*(guarded_comment(f"COMMENT {note}") for note in notes), "HORIZONTAL 360"]
    lines += [f"{i} {peak - v:.2f}" for i, v in enumerate(level)]
    lines += ["VERTICAL 360", *(f"{i} {peak - v:.2f}" for i, v in enumerate(over))]
    return "\n".join(lines) + "\n"


_WHAT = "a table of the directions at which a gain is known"
_COLUMNS = ("azimuth_deg", "elevation_deg", "covariance_db2 (columns up to the row's own)")


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionCovariance:
    """Unit vectors (m, 3) in the body frame, and the covariance (m, m) of the gain towards them [dB^2]."""

    directions: FloatArray
    covariance_db2: FloatArray

    def table(self, notes: Sequence[str]) -> str:
        """Return the content of the table, with comments at its head."""
        rows = enumerate(np.column_stack([angles_of(self.directions), self.covariance_db2]))
        lines = (
            f"{azimuth:.1f},{elevation:.1f}," + ",".join(f"{value:.2f}" for value in row[: number + 1])
            for number, (azimuth, elevation, *row) in rows
        )
        return _table(notes, _COLUMNS, lines)


@parsed(_WHAT)
def read_direction_covariance(path: Path, written: Written | None = None) -> DirectionCovariance:
    """Read a table of :meth:`DirectionCovariance.table`.

    Raises
    ------
    InputError
        If columns or lengths of rows are wrong, a value is not finite, or the table has changed since it was written.
    """
    rows = _numbers(path, _WHAT, _COLUMNS, written)
    if [len(row) for row in rows] != [*range(3, len(rows) + 3)]:
        raise InputError("rows of another length", expected=", ".join(_COLUMNS), path=path)
    lower = np.zeros((len(rows), len(rows)))
    lower[np.tril_indices(len(rows))] = np.concatenate([row[2:] for row in rows])
    return DirectionCovariance(
        directions=vectors_of(np.array([row[:2] for row in rows])), covariance_db2=lower + np.tril(lower, -1).T
    )


def learned_antenna(named: Named, end: str, carrier_hz: float) -> tuple[Path, LearnedAntenna]:
    """Return the path of the table of a learned antenna, and the properties of the antenna with its error model.

    Parameters
    ----------
    named : Named
    end : {"uav", "tower"}
    carrier_hz : float
        Carrier of the link [Hz].

    Raises
    ------
    UsageError
        If there is no antenna of that name for this end, or it has another band.
    InputError
        If the table is damaged or changed, or was learned from logs that its entry does not name.
    """
    series = named.antenna(end, carrier_hz)
    if series is None:
        raise UsageError("the entry has no such antenna", expected="one that the entry has")
    check_band(series.carrier_hz, carrier_hz, AIRFRAME_BAND if end == "uav" else BAND)
    file = series.uav_file if end == "uav" else series.tower_file
    path, written = named.folder / file, named.written(file)
    check_logs(read_sphere_csv(path, written).trained_on, named, path)
    pair = series.pair
    if pair is not None:
        read_pair(named.folder / pair.file, pair.length, pair.prior_sd_db, named.written(pair.file))
        pair = pair.model_copy(update={"file": str(named.folder / pair.file), "sha256": named.entry.tables[pair.file]})
    spread = series.spread if end == "tower" else _airframe_spread(named.entry.errors, series.spread)
    return path, LearnedAntenna(
        sha256=written.sha256, command=written.command, pair=pair if end == "tower" else None, spread=spread
    )


def _airframe_spread(errors: Errors | None, spread: LearnedSpread) -> LearnedSpread:
    """Return the error model of a level with the learned airframe alone.

    The unknown gain of the other end becomes part of the error model. The total error is the RMSE of the airframe alone
    on held-out campaigns, or the RMSE of free space if no campaign was held out.
    """
    if errors is None:
        return spread
    alone_db = errors.free_space_rmse_db if errors.airframe_rmse_db is None else errors.airframe_rmse_db
    own_db2 = alone_db**2 - spread.noise_sd_db**2 - spread.fading_sd_db**2
    return spread.model_copy(update={"own_sd_db": round(max(own_db2, spread.own_sd_db**2) ** 0.5, 3)})


def check_band(learned_hz: float, used_hz: float, band: float, key: str = "") -> None:
    """Refuse learned antennas in another band.

    Parameters
    ----------
    learned_hz, used_hz : float
        Carriers at which the antennas were learned and are used [Hz].
    band : float
        Largest relative difference of the carriers.
    key : str
        Start of the message, which names the antennas.

    Raises
    ------
    UsageError
        If the relative difference of the carriers exceeds ``band``.
    """
    if abs(used_hz / learned_hz - 1.0) > band:
        raise UsageError(
            f"{key}learned at {learned_hz / 1e9:g} GHz, used at {used_hz / 1e9:g} GHz",
            expected=f"a carrier within {100 * band:g} %: farther bands were not compared",
        )


def receiver_file(named: Named, carrier_hz: float) -> Path:
    """Return the file of a learned rank receiver, after a check of its band and its training logs.

    Parameters
    ----------
    named : Named
        An entry with a receiver.
    carrier_hz : float
        Carrier of the rank link [Hz].

    Raises
    ------
    UsageError
        If the receiver has another band.
    InputError
        If the table is damaged, or was learned from logs that its entry does not name.
    """
    check_band(named.entry.receivers[0].carrier_hz, carrier_hz, BAND)
    path = named.folder / named.entry.receivers[0].file
    with parsing(path, "a rank receiver"):
        content = json.loads(read_table(path, "a rank receiver", named.written(path.name)))
    check_logs(content.get("trained_on", []) if isinstance(content, dict) else [], named, path)
    return path


def check_logs(trained_on: Sequence[str], named: Named, path: Path) -> None:
    """Refuse a table learned from logs that its entry does not name, because they could otherwise be scored."""
    strange = set(trained_on) - set(named.entry.trained_on)
    if strange:
        raise InputError(
            f"learned from logs (SHA-256 {min(strange)[:12]}...) that its entry does not name",
            expected="the table that was written with the entry",
            cause="a table of another calibration",
            path=path,
        )
