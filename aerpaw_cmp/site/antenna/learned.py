"""Calibrations of a site from flights, beside its file: ``NAME.learned/learned.yaml`` and the tables that it names.

Each entry is a calibration: learned antennas by tower, channel and reader, its airframe, or a rank receiver, with the
band and the logs (SHA-256) that it was learned from, its errors on flights left out, the source of the flights and the
command that made it.
"""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field

from ...common.counting import counted
from ...common.errors import InputError, UsageError, parsing
from ...common.files import LARGEST_TABLE, inside, locked, read_bounded, write_whole
from ...common.outputs import explained_os_errors, file_digest
from ...common.yamlfile import StrictModel, dump_yaml, load_yaml

_INDEX = "learned.yaml"

# Share by which a carrier may differ from the one that a tower's antenna was learned at.
# Lake Wheeler's bands at 3.3, 3.4 and 3.51 GHz lie 3 % apart: other antennas, other gains.
BAND = 0.02

# The same for an airframe: 3.3 and 3.51 GHz share 90 % of the variance of its gain. Farther bands were never compared.
AIRFRAME_BAND = 0.07


class Source(StrictModel):
    """Source of the flights, as calibration.yaml says."""

    title: str = ""
    doi: str = ""
    licence: str = "not stated"
    airframe: str = "not stated"


class Errors(StrictModel):
    """Means over held-out series: RMSE [dB] after one offset, and the share inside 90 % intervals.

    ``rmse_db`` is that of held-out flights; ``height_rmse_db``, ``sector_rmse_db`` and ``heading_rmse_db`` are those of
    heights, sectors of azimuth at the tower and headings that no other flight has. ``heights_m``: the cruise heights.
    """

    series: int
    rmse_db: float
    rmse_4s_db: float
    free_space_rmse_db: float
    inside_90: float
    sector_rmse_db: float | None = None
    height_rmse_db: float | None = None
    heading_rmse_db: float | None = None
    heights_m: list[float] = Field(default_factory=list)


class LearnedLock(StrictModel):
    """Lock probability of a receiver: P = 1 / (1 + exp(-per_db (path gain - gain_db))) of the predicted path gain [dB].

    In lock the levels lie about ``locked_db`` at ``gain_db``, ``locked_per_db`` higher for each dB of path gain (less
    than 1: of weak levels the receiver locks on the strong), with ``locked_sd_db`` in a flight; without lock about
    ``lost_db`` and so on [unit of the measurement].
    The scores are means over flights left out: Brier and log score (nat) beside those of each flight's own share, and
    the RMSE [dB] of all samples where levels below the floor count as the floor.
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
    """Level of a log minus free space of a transmit power and the gains as written [dB]; ``sd_db``: of a new flight."""

    offset_db: float
    sd_db: Annotated[float, Field(gt=0)]
    transmit_power_dbm: float
    unit: str


class LearnedSpread(StrictModel):
    """Error model of a level besides the SD of the gain: see :class:`aerpaw_cmp.compare.gains.spread.Spread`."""

    own_sd_db: Annotated[float, Field(ge=0)]
    noise_sd_db: Annotated[float, Field(ge=0)]
    fading_sd_db: Annotated[float, Field(ge=0)]
    fading_kurtosis: float
    bin_s: Annotated[float, Field(gt=0)]


class LearnedPair(StrictModel):
    """Gain towards both ends at once: its table, and the kernel that interpolates it."""

    file: str
    sha256: str | None = None
    """Of the table, where no index names it."""
    length: Annotated[float, Field(gt=0)]
    prior_sd_db: Annotated[float, Field(ge=0)]


class LearnedAntenna(StrictModel):
    """Knowledge about a learned antenna besides its table, as a flight file or calibrated.yaml contains it."""

    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    """Of the table; another table is refused."""
    command: str
    """Command that learns it again."""
    pair: LearnedPair | None = None
    spread: LearnedSpread


class LearnedHealth(StrictModel):
    """Errors of held-out flights of one channel, by which faults of a later flight are judged; None: not measured.

    ``slow_sd_db`` is the SD of the correlated part of the error, with its correlation time and length; ``white_sd_db``
    the SD of the rest of 4-s means. ``channel_difference_db`` are differences of the offset to other channels, by name.
    ``run`` is the usual longest run of equal readings.
    """

    rmse_db: float | None = None
    slow_sd_db: float | None = None
    correlation_s: float | None = None
    correlation_m: float | None = None
    white_sd_db: float | None = None
    offset_db: float | None = None
    offset_sd_db: float | None = None
    channel_difference_db: dict[str, float] = Field(default_factory=dict)
    channel_difference_sd_db: dict[str, float] = Field(default_factory=dict)
    below_lock_share: float | None = None
    run: float | None = None


class LearnedSeries(StrictModel):
    """Antennas of one tower and channel, and the properties of the levels of that channel."""

    tower: str
    channel: str
    """Label of the antenna in the flights that were learned from; a name, not a condition."""
    receiver: str = ""
    """Receiver whose level ``level`` and ``lock`` describe, as ``receiver`` of a flight file; empty: not named."""
    carrier_hz: float
    tower_file: str
    uav_file: str
    known_file: str
    """Directions at the UAV that determine its gain, and the covariance of the gain there."""
    pair: LearnedPair | None = None
    spread: LearnedSpread
    sd_db: float
    """Mean standard deviation of the level over directions that were flown."""
    shares_airframe: bool = True
    """False if the gain of the UAV does not predict held-out flights of its own campaign: it is not used elsewhere."""
    lock: LearnedLock | None = None
    level: LearnedLevel | None = None
    """Of receivers that lose their lock: of the levels in lock."""
    health: LearnedHealth | None = None

    @property
    def files(self) -> list[str]:
        """Names of the tables."""
        return [self.tower_file, self.uav_file, self.known_file, *([] if self.pair is None else [self.pair.file])]


class LearnedReceiver(StrictModel):
    """A rank receiver of one tower: error on flights left out as kappa and log score beside the constant forecast."""

    tower: str
    quantity: str
    """Rank that it was learned from, such as ``scheduled PDSCH rank``; whatever reader reads it."""
    carrier_hz: float
    file: str
    kappa: float | None = None
    log_score: float | None = None
    constant_log_score: float | None = None


class Entry(StrictModel):
    """Antennas and receivers of one campaign, as one calibration learned them."""

    command: str
    made: str
    flights: list[str]
    flown: list[str]
    joined: list[str] = Field(default_factory=list)
    """Other campaigns whose flights the gain of the UAV was learned from as well."""
    trained_on: list[Annotated[str, Field(pattern="^[0-9a-f]{64}$")]]
    """SHA-256 of all logs of the calibration."""
    source: Source = Source()
    errors: Errors | None = None
    series: list[LearnedSeries] = Field(default_factory=list)
    receivers: list[LearnedReceiver] = Field(default_factory=list)
    ground_roughness_m: float | None = None
    tables: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)
    """SHA-256 of the tables as they were written: nothing else is ever replaced or removed."""
    sha256: str = ""
    """Of all other values of the entry."""

    @property
    def digest(self) -> str:
        """SHA-256 of the values, without ``sha256``."""
        values = self.model_dump(mode="json", exclude={"sha256"}, exclude_none=True)
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

    def about(self) -> str:
        """Return one sentence: learned from which flights, and which error to expect."""
        days = f" of {', '.join(self.flown)}" if self.flown else ""  # none where the logs have relative times
        text = f"learned on {counted(len(self.flights), 'flight')}{days}"
        text += f", the UAV also on {', '.join(self.joined)}" if self.joined else ""
        if self.errors is not None:
            text += (
                f"; expect an RMSE of {self.errors.rmse_db:.1f} dB on another flight, free space "
                f"{self.errors.free_space_rmse_db:.1f} dB"
            )
        for lock in [item.lock for item in self.series if item.lock is not None][:1]:
            text += (
                f", {lock.floor_rmse_db:.1f} and {lock.free_space_floor_rmse_db:.1f} dB where levels below "
                f"{lock.floor_db:g} count as {lock.floor_db:g}"
            )
        kappas = [receiver.kappa for receiver in self.receivers if receiver.kappa is not None]
        return text + (f"; expect kappa {sum(kappas) / len(kappas):.2f} on another flight" if kappas else "")


class _Foreign(BaseModel, extra="allow"):
    """An entry of another version: nothing is read of it, but others can be replaced beside it."""

    tables: dict[str, str] = Field(default_factory=dict)


_Name = Annotated[str, Field(pattern="^[A-Za-z0-9][A-Za-z0-9_.-]*$")]


class Learned(StrictModel):
    """All that a site remembers, by name."""

    format: Literal["aerpaw-cmp learned 3"] = "aerpaw-cmp learned 3"
    entries: dict[_Name, Entry] = Field(default_factory=dict)


class _Index(Learned):
    """The same as it is written, with entries of any version."""

    # a newer entry must not be lost because an older version adds one beside it
    entries: dict[_Name, Entry | _Foreign] = Field(default_factory=dict)  # type: ignore[assignment]


def folder_of(site: str | Path) -> Path:
    """Folder of what a site remembers: beside its file, or in the package."""
    path = Path(site)
    if path.suffix in (".yaml", ".yml") or path.is_file():
        return path.with_suffix(".learned")
    name = str(site).lower().replace("-", "_").replace(" ", "_")
    return Path(str(resources.files("aerpaw_cmp.site") / "data" / f"{name}.learned"))


def read_learned(site: str | Path) -> Learned:
    """Read the memory of a site; empty for a site without one.

    Raises
    ------
    UsageError
        An index that is damaged, or of another version; values that were edited.
    InputError
        It names a file outside its folder.
    """
    folder = folder_of(site)
    memory = _read(folder, Learned)
    for name, entry in memory.entries.items():
        if entry.sha256 != entry.digest:
            raise UsageError(
                f"the values of {name!r} are not those that were written (SHA-256)",
                expected=f"an entry as calibrate writes it; learn it again: {entry.command}",
                cause="an edited value",
                path=folder / _INDEX,
            )
    return memory


def _read(folder: Path, model: type[Learned]) -> Learned:
    index = inside(folder, _INDEX, folder / _INDEX)
    memory = load_yaml(index, model) if index.is_file() else model()
    for name in {name for entry in memory.entries.values() for name in (*files_of(entry), *entry.tables)}:
        # before any is opened: an index may come from a stranger
        inside(folder, name, index, plain=True)
    return memory


def remember(site: str | Path, name: str, entry: Entry, files: Mapping[str, bytes]) -> list[Path]:
    """Write an entry and its tables (name: content, packed here) into the memory of a site; the index comes last.

    Parameters
    ----------
    site : str or Path
    name : str
        Of the entry; one of this name is replaced.
    entry : Entry
    files : mapping of str to bytes
        As the entry names them, with the ending ``.gz``.

    Returns
    -------
    list of Path

    Raises
    ------
    UsageError
        A file of the name of a table that no calibration wrote; a damaged index.
    InputError, OutputError
        As :func:`read_learned`; the folder cannot be written.
    """
    folder = folder_of(site)
    # mtime=0: the same content has the same bytes, and so the same SHA-256
    packed = {file: gzip.compress(content, 9, mtime=0) for file, content in files.items()}
    tables = {file: hashlib.sha256(content).hexdigest() for file, content in packed.items()}
    with explained_os_errors(folder):
        folder.mkdir(exist_ok=True)
        # two calibrations of one site at once: each must see the other's entry
        with locked(folder):
            memory = _read(folder, _Index)
            # what an entry names with its digest is ours, and so is an edited table or one of a killed calibration
            written = {item for known in memory.entries.values() for item in known.tables.items()}
            for file in packed:
                place = inside(folder, file, folder / _INDEX, plain=True)
                known = {*written, *tables.items()}
                if place.exists() and (file, file_digest(place)) not in known and not _is_table(place):
                    raise UsageError(
                        "no calibration wrote this file",
                        expected="another 'calibration:' name, or that file moved away",
                        path=place,
                    )
            for file, content in packed.items():
                write_whole(folder / file, content)
            made = entry.model_copy(update={"tables": tables})
            made = made.model_copy(update={"sha256": made.digest})
            entries = dict(sorted({**memory.entries, name: made}.items()))
            text = dump_yaml(memory.model_copy(update={"entries": entries}).model_dump(mode="json", exclude_none=True))
            # after the tables that it names: a reader meets no entry without its files
            write_whole(folder / _INDEX, text)
            used = {file for known in entries.values() for file in files_of(known)}
            for file, digest in sorted(written):
                # changed since, it is no longer the table that was written: it stays
                if file not in used and (folder / file).is_file() and file_digest(folder / file) == digest:
                    (folder / file).unlink()
    return [folder / _INDEX, *(folder / file for file in files)]


def carry_memory(base: str | Path, site: Path) -> list[str]:
    """Copy the memory of a base beside a site made of it, which has none yet; a line that says so."""
    origin, folder = folder_of(base), folder_of(site)
    if not origin.is_dir() or (folder / _INDEX).exists():
        return []
    entries = read_learned(base).entries
    with explained_os_errors(folder):
        folder.mkdir(exist_ok=True)
        # the index last: until it is there the new site has no memory
        for name in [*sorted(set().union(*map(files_of, entries.values()))), _INDEX]:  # without it there is no memory
            place = inside(origin, name, origin / _INDEX, plain=True)
            if place.is_file() and not (folder / name).exists():
                write_whole(folder / name, place.read_bytes())
    return [f"learned antennas and receivers of the base were copied to {folder.name}: {', '.join(entries)}"]


def memory_lines(site: str | Path) -> list[str]:
    """Lines that say what a site remembers."""
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


def files_of(entry: Entry | _Foreign) -> set[str]:
    """Names of the tables of an entry."""
    if isinstance(entry, _Foreign):
        return set(entry.tables)
    return {file for s in entry.series for file in s.files} | {r.file for r in entry.receivers}


# Begins the comment that names a calibration and, after ``, from``, its flights.
LEARNED = "# aerpaw-cmp calibrate: "


def _is_table(place: Path) -> bool:
    """Check whether a file is a table of some calibration: it begins as one, or is a rank receiver."""
    with suppress(InputError, OSError, EOFError):
        content = read_table(place, "a table")
        return content.startswith(LEARNED.encode()) or (content.startswith(b"{") and b'"trained_on"' in content)
    return False


@dataclass(frozen=True, slots=True)
class Written:
    """SHA-256 of a file as a calibration wrote it, and the command that writes it again."""

    sha256: str
    command: str


def read_table(path: Path, expected: str, written: Written | None = None) -> bytes:
    """Return the content of a table, packed or not.

    Parameters
    ----------
    path : Path
    expected : str
        What the table is, for messages.
    written : Written, optional
        The table must be as it was written.

    Raises
    ------
    OSError
    InputError
        Too large, a damaged packed file, or not as it was written.
    """
    content = read_bounded(path, LARGEST_TABLE, expected)
    if written is not None and hashlib.sha256(content).hexdigest() != written.sha256:
        raise InputError(
            f"this table is not the one that was learned (SHA-256 {written.sha256[:12]}...)",
            expected=f"{expected} as it was written; learn it again: {written.command}",
            cause="an edited table, or a calibration that was killed while it wrote",
            path=path,
        )
    if not content.startswith(b"\x1f\x8b"):
        return content
    with parsing(path, expected, "a cut copy"), gzip.open(path) as book:
        # one byte more than allowed tells a table that is too large without unpacking all of it
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
        """Return the series whose antenna fits an end (``uav``, ``tower``) of a link; None if there is none."""
        if end == "tower":
            return next((s for s in self.entry.series if f"{s.tower}.{s.channel}" == self.part), None)
        # an airframe has one antenna for all channels of a band
        return min(self.entry.series, key=lambda s: abs(s.carrier_hz / carrier_hz - 1.0), default=None)

    def written(self, file: str) -> Written:
        """Return the SHA-256 of a table of the entry, and the command that writes it."""
        return Written(self.entry.tables[file], self.entry.command)


class UnknownName(UsageError):  # noqa: N818  # a case of its base, which is the error
    """A name of the learned models of a site that can never apply."""


def find_named(name: str, folder: Path, end: str = "") -> Named:
    """Return the entry of a name ``SITE/ENTRY``, ``SITE/ENTRY_uav`` or ``SITE/ENTRY_TOWER.CHANNEL``.

    Parameters
    ----------
    name : str
    folder : Path
        Where sites that are not packaged lie: SITE.learned in it.
    end : {"uav", "tower", "receiver", ""}
        Part that is wanted: the airframe, the antenna of a tower, a rank receiver, or any.

    Raises
    ------
    UnknownName
        No such site, entry or part, or a part for another end.
    UsageError
        A memory that cannot be read.
    """
    site, _, entry_part = name.rpartition("/")
    # a site beside the flight file comes before a packaged one of its name
    place: str | Path = folder.absolute() / f"{site}.yaml"  # the paths in it hold in any working folder
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
        f"nothing learned is called {name!r}" + (f" for {_WANTED[end]}" if end else ""),
        expected="one of " + ", ".join(fitting) if fitting else "SITE/ENTRY of a site with learned models",
        cause=None if fitting else f"there is no such learned model in {folder_of(place)}",
    )


_WANTED = {"uav": "the UAV", "tower": "a tower", "receiver": "the rank receiver"}


def _parts(name: str, entry: Entry, end: str) -> dict[str, str]:
    """Return the full names of the parts of an entry that fit an end, by part."""
    parts = {"": name} if end in ("", "receiver") and (not end or entry.receivers) else {}
    if end in ("", "uav") and entry.series:
        parts["uav"] = f"{name}_uav"
    if end in ("", "tower"):
        parts |= {f"{s.tower}.{s.channel}": f"{name}_{s.tower}.{s.channel}" for s in entry.series}
    return parts
