"""Calibrations of a site from flights, beside its file: ``NAME.learned/learned.yaml`` and the tables that it names.

Each entry is a calibration: learned antennas by tower, channel and reader, its airframe, or a rank receiver, with the
band and the logs (SHA-256) that it was learned from, its errors on flights left out, the source of the flights and the
command that made it.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Mapping
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

# Share by which a carrier may differ from the one that an antenna was learned at.
# Lake Wheeler's bands at 3.3, 3.4 and 3.51 GHz lie 3 % apart: other antennas, other gains.
BAND = 0.02


# Readers of exports of one receiver: what the one taught holds for the other.
# The same phone and the same readings, saved by its program as KML or as CSV.
_EXPORTS = {"nemo_kml": "nemo_csv"}


def receiver_of(reader: str) -> str:
    """Name of the receiver whose readings a reader reads: that of the first of its readers."""
    return _EXPORTS.get(reader, reader)


class Source(StrictModel):
    """Source of the flights, as calibration.yaml says."""

    title: str = ""
    doi: str = ""
    licence: str = "not stated"
    airframe: str = "not stated"


class Errors(StrictModel):
    """On flights left out, means over series: RMSE [dB] after one offset, and the share inside 90 % intervals."""

    series: int
    rmse_db: float
    rmse_4s_db: float
    free_space_rmse_db: float
    inside_90: float
    sector_rmse_db: float | None = None


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


class LearnedSeries(StrictModel):
    """Antennas of one tower and channel, and what the log of that channel looks like."""

    tower: str
    channel: str
    reader: str
    carrier_hz: float
    tower_file: str
    uav_file: str
    sd_db: float
    """Mean standard deviation of the level over directions that were flown."""
    lock: LearnedLock | None = None
    level: LearnedLevel | None = None
    """Of receivers that lose their lock: of the levels in lock."""


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
    """One calibration."""

    command: str
    made: str
    flights: list[str]
    flown: list[str]
    trained_on: list[Annotated[str, Field(pattern="^[0-9a-f]{64}$")]]
    source: Source = Source()
    errors: Errors | None = None
    series: list[LearnedSeries] = Field(default_factory=list)
    receivers: list[LearnedReceiver] = Field(default_factory=list)
    ground_roughness_m: float | None = None
    tables: dict[str, Annotated[str, Field(pattern="^[0-9a-f]{64}$")]] = Field(default_factory=dict)
    """SHA-256 of the tables as they were written: nothing else is ever replaced or removed."""

    def about(self) -> str:
        """One sentence: learned from what, and what error to expect."""
        days = f" of {', '.join(self.flown)}" if self.flown else ""  # none where the logs have relative times
        text = f"learned on {counted(len(self.flights), 'flight')}{days}"
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

    format: Literal["aerpaw-cmp learned 2"] = "aerpaw-cmp learned 2"
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
        An index that is damaged, or of another version.
    InputError
        It names a file outside its folder.
    """
    return _read(folder_of(site), Learned)


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
        A file of the name of a table that no calibration wrote, or that was changed since; a damaged index.
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
            # what an entry names with its digest is ours; all else is somebody's file
            written = {item for known in memory.entries.values() for item in known.tables.items()}
            for file in packed:
                place = inside(folder, file, folder / _INDEX, plain=True)
                if place.exists() and (file, file_digest(place)) not in {*written, *tables.items()}:
                    raise UsageError(
                        "no calibration wrote this file, or it was changed since",
                        expected="another 'calibration:' name, or that file moved away",
                        path=place,
                    )
            for file, content in packed.items():
                write_whole(folder / file, content)
            entries = dict(sorted({**memory.entries, name: entry.model_copy(update={"tables": tables})}.items()))
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
    return {f for s in entry.series for f in (s.tower_file, s.uav_file)} | {r.file for r in entry.receivers}


def read_table(path: Path, expected: str) -> bytes:
    """Content of a table, packed or not.

    Raises
    ------
    OSError
    InputError
        Too large, or a damaged packed file.
    """
    content = read_bounded(path, LARGEST_TABLE, expected)
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

    def antenna(self, tower: str, channel: str, end: str) -> LearnedSeries | None:
        """The series whose antenna fits an end (``uav``, ``tower``) of a link; of an airframe, of any channel."""
        if end == "tower":
            return next((s for s in self.entry.series if f"{s.tower}.{s.channel}" == self.part), None)
        exact = [s for s in self.entry.series if (s.tower, s.channel) == (tower, channel)]
        # an airframe carries one antenna, whichever channel taught it
        return next(iter([*exact, *self.entry.series]), None)


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
