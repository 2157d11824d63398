"""The tasks of an entrant: files identified by their bytes, flights, splits, and the table of each task."""

from __future__ import annotations

import gzip
import hashlib
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import yaml
from pydantic import Field

import aerpaw_cmp
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.common.units import BoolArray, IntArray
from aerpaw_cmp.common.yamlfile import StrictModel, load_yaml

SECTORS, SECTOR_GUARD_DEG = 6, 10.0
BLOCK_M, BLOCK_GUARD_M = 300.0, 20.0
STRETCHES, STRETCH_GUARD_S = 8, 20.0

KEY = ["task", "flight", "tower", "channel", "time"]
SERIES = ["flight", "tower", "channel"]
RANKS = ["p_rank1", "p_rank2", "p_rank3", "p_rank4"]

Split = Literal["flights", "sectors", "blocks", "stretches"]


class FileEntry(StrictModel):
    """A published file, known by its bytes after unpacking."""

    repository: str
    path: str
    bytes: int
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    licence: str
    doi: str | None = None
    also: dict[str, int] = Field(default_factory=dict)
    """SHA-256 and size of other files with the same samples."""


class Task(StrictModel):
    """Definition of a task: what is predicted from what."""

    title: str
    kind: Literal["level", "rank"] = "level"
    split: Split = "flights"
    train: list[str] = Field(default_factory=list)
    test: Annotated[list[str], Field(min_length=1)]

    @property
    def own_offset(self) -> bool:
        """True if each series is scored about its own mean error: its own flight is not among what is known."""
        return self.split in ("flights", "sectors")

    @property
    def rule(self) -> str:
        """The data that an entrant may use, and how its levels are scored."""
        known = {
            "flights": "the training flights",
            "sectors": f"the training flights outside the sample's sector of {360 // SECTORS} degrees at the tower "
            f"(and {SECTOR_GUARD_DEG:g} degrees beside it)",
            "blocks": f"the training flights, and the test flight outside the sample's block of {BLOCK_M:g} m "
            f"(and {BLOCK_GUARD_M:g} m around it)",
            "stretches": f"the flight outside the sample's {STRETCHES}th of its time (and {STRETCH_GUARD_S:g} s "
            "beside it)",
        }[self.split]
        if self.kind == "rank":
            return f"Known: {known}. Scored is the probability of each rank."
        offset = "about the mean error of each flight, tower and channel" if self.own_offset else "as they are"
        return f"Known: {known}. Levels count {offset}."


class Manifest(StrictModel):
    """Files, flights and tasks of one version of the benchmark."""

    version: int
    files: dict[str, FileEntry]
    flights: dict[str, dict[str, Any]]
    """Each the content of a flight.yaml whose ``path`` names a file of this manifest."""
    tasks: dict[str, Task]


MANIFEST = Path(__file__).with_name("tasks.yaml")


# --- data ----------------------------------------------------------------------------------------------------------


def locate(manifest: Manifest, folder: Path) -> dict[str, Path]:
    """Files of the manifest below a folder, by content, whatever they are called.

    Raises
    ------
    InputError
        The folder cannot be read; a file of a published name has other bytes.
    """
    if not folder.is_dir():
        raise InputError("no such folder", expected="the folder of the published logs (--data)", path=folder)
    names_by_digest = {digest: name for name, entry in manifest.files.items() for digest in (entry.sha256, *entry.also)}
    sizes = {size for item in manifest.files.values() for size in (item.bytes, *item.also.values())}
    places: dict[str, Path] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = names_by_digest.get(_content_digest(path, sizes))
        if name is not None:
            places.setdefault(name, path)
    known = {Path(entry.path).name: name for name, entry in manifest.files.items()}
    for path in folder.rglob("*.mat"):
        name = known.get(path.name, "")
        if name and name not in places:
            raise InputError(
                f"SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()}",
                expected=f"{manifest.files[name].sha256}, as {manifest.files[name].repository} publishes it",
                cause="a changed or damaged copy",
                path=path,
            )
    return places


def _content_digest(path: Path, sizes: set[int]) -> str:
    """Return the SHA-256 of a file after unpacking. Empty if no file with this size is expected."""
    with path.open("rb") as stream:
        zipped = stream.read(2) == b"\x1f\x8b"
    if not zipped:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.stat().st_size in sizes else ""
    try:
        with gzip.open(path) as stream:
            content = stream.read(max(sizes) + 1)
    except (OSError, EOFError, zlib.error):
        return ""
    return hashlib.sha256(content).hexdigest() if len(content) in sizes else ""


class Bench:
    """The tasks with the logs below a folder."""

    def __init__(self, folder: Path, manifest: Path = MANIFEST) -> None:
        self.folder = folder
        self.manifest = load_yaml(manifest, Manifest)
        self._opened: dict[str, aerpaw_cmp.Flight] = {}
        self._tables: dict[tuple[str, str], pd.DataFrame] = {}

    @cached_property
    def places(self) -> dict[str, Path]:
        """Paths of the files, by name."""
        return locate(self.manifest, self.folder)

    def logs_of(self, flight: str) -> list[str]:
        """Names of a flight's files."""
        return [log["path"] for log in self.manifest.flights[flight]["logs"]]

    def missing(self, flight: str) -> list[str]:
        """Files of a flight that are not at hand."""
        return [name for name in self.logs_of(flight) if name not in self.places]

    def flight(self, name: str) -> aerpaw_cmp.Flight:
        """A flight, read once."""
        if name not in self._opened:
            content = self.manifest.flights[name]
            logs = [{**log, "path": str(self.places[log["path"]].resolve())} for log in content["logs"]]
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "flight.yaml"
                text = yaml.safe_dump({**content, "flight": {"name": name}, "logs": logs})
                file.write_text(text, encoding="utf-8")
                self._opened[name] = aerpaw_cmp.open_flight(file)
        return self._opened[name]

    def skipped(self, task: str, *, training: bool) -> list[str]:
        """List the missing files of a task with their sources. The list is empty if the task can be run."""
        spec = self.manifest.tasks[task]
        absent = [name for flight in (*spec.test, *(spec.train if training else ())) for name in self.missing(flight)]
        return [
            f"{name}: {self.manifest.files[name].path} of {self.manifest.files[name].repository}"
            for name in dict.fromkeys(absent)
        ]

    def tests(self, task: str) -> list[str]:
        """Test flights at hand."""
        return [flight for flight in self.manifest.tasks[task].test if not self.missing(flight)]

    def chosen(self, names: list[str]) -> list[str]:
        """Return the named tasks, or all. An unknown name raises UsageError."""
        for name in names:
            if name not in self.manifest.tasks:
                raise UsageError(f"unknown task {name!r}", expected=", ".join(self.manifest.tasks))
        return names or list(self.manifest.tasks)

    # --- tables ----------------------------------------------------------------------------------------------------

    def table(self, task: str, flight: str) -> pd.DataFrame:
        """Rows of one flight: key, fold, number of the sample in its series, geometry, and ``measured``.

        ``measured`` is a level [dB] or a rank; rows are those above the minimum height at known positions.
        """
        if (task, flight) not in self._tables:
            self._tables[task, flight] = self._table(task, flight)
        return self._tables[task, flight]

    def _table(self, task: str, flight: str) -> pd.DataFrame:
        spec, opened = self.manifest.tasks[task], self.flight(flight)
        rank = spec.kind == "rank"
        frame = opened.rank.assign(channel="rank", measured=opened.rank["rank"]) if rank else (
            opened.rss.assign(measured=opened.rss["measured_db"])
        )  # fmt: skip
        settings = opened.settings
        low = (settings.rank if rank else settings.rss).minimum_height_m
        link = settings.link.rank if rank else settings.link.rss
        frame = frame.assign(sample=frame.groupby(["tower", "channel"], sort=False).cumcount())
        keep = np.isfinite(frame[["measured", "east_m", "north_m", "up_m"]]).all(axis=1)
        keep &= (frame["measured"] >= 1 if rank else True) & (True if low is None else frame["up_m"] >= low)
        frame = frame[keep].sort_values(["tower", "channel", "time"], kind="stable", ignore_index=True)
        towers = np.array([opened.site.towers[name].position_m for name in frame["tower"]]).reshape(-1, 3)
        table = pd.DataFrame(
            {
                "task": task,
                "flight": flight,
                **{name: frame[name] for name in ("tower", "channel")},
                "time": _texts(frame),
            }
        )
        place = {name: frame[name].round(3) for name in ("east_m", "north_m", "up_m")}
        place |= {f"tower_{name}": towers[:, i].round(3) for i, name in enumerate(("east_m", "north_m", "up_m"))}
        table = table.assign(
            sample=frame["sample"], **place, heading_deg=_headings(opened.track, frame), carrier_hz=link.carrier_hz,
            measured=frame["measured"],
        )  # fmt: skip
        return table.drop_duplicates(KEY, ignore_index=True).assign(fold=lambda rows: folds_of(spec.split, rows))

    def rows(self, task: str, *, training: bool = False) -> pd.DataFrame:
        """Tables of the test flights at hand, or of the training flights, in one."""
        spec = self.manifest.tasks[task]
        flights = [f for f in spec.train if not self.missing(f)] if training else self.tests(task)
        empty = pd.DataFrame(columns=[*KEY, "fold", "measured"])
        return pd.concat([self.table(task, name) for name in flights] or [empty], ignore_index=True)

    def questions(self, task: str, flight: str) -> Iterator[Question]:
        """Every fold of one test flight."""
        spec, asked = self.manifest.tasks[task], self.table(task, flight)
        train = {name: self.table(task, name) for name in spec.train}
        for fold in np.unique(asked["fold"]):
            target = asked[asked["fold"] == fold]
            known = [rows[may_know(spec.split, rows, target, same_flight=False)] for rows in train.values()]
            if not spec.own_offset:
                known.append(asked[may_know(spec.split, asked, target, same_flight=True)])
            yield Question(pd.concat(known, ignore_index=True), target.drop(columns="measured"))


@dataclass(frozen=True, slots=True)
class Question:
    """One fold of a task: rows with ``measured`` that an entrant may know, and rows without it to be answered."""

    known: pd.DataFrame
    asked: pd.DataFrame


def _texts(frame: pd.DataFrame) -> list[str]:
    """Instants (n,) as ISO 8601 text to the microsecond, the key of a row."""
    instants = frame["time"].dt.tz_convert("UTC").dt.tz_localize(None).to_numpy("datetime64[us]")
    return [f"{t}Z" for t in np.datetime_as_string(instants, unit="us")]


def _headings(track: pd.DataFrame, frame: pd.DataFrame) -> Any:
    """Return the heading (n,) of the nose at the samples, clockwise from north [deg]. It is NaN without telemetry."""
    if track.empty:
        return np.nan
    turned = np.unwrap(track["heading_deg"], period=360.0)
    return (np.interp(_seconds(frame), _seconds(track), turned) % 360.0).round(3)


# --- splits --------------------------------------------------------------------------------------------------------


def _bearing_deg(rows: pd.DataFrame) -> Any:
    """Compass bearing (n,) of the UAV from the tower [deg]."""
    east, north = ((rows[f"{axis}_m"] - rows[f"tower_{axis}_m"]).to_numpy() for axis in ("east", "north"))
    return np.degrees(np.arctan2(east, north)) % 360.0


def _seconds(rows: pd.DataFrame) -> Any:
    return pd.DatetimeIndex(pd.to_datetime(rows["time"])).as_unit("ns").asi8 / 1e9


def folds_of(split: Split, rows: pd.DataFrame) -> IntArray:
    """Fold (n,) of each row of one test flight: those of one fold are predicted together."""
    if split == "sectors":
        return np.asarray(_bearing_deg(rows) // (360.0 / SECTORS), dtype=np.int64)
    if split == "blocks":
        cell = np.floor(rows[["east_m", "north_m"]].to_numpy() / BLOCK_M).astype(np.int64)
        return np.asarray(np.unique(cell, axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)
    if split == "stretches":
        time = _seconds(rows)
        start, span = (rows.assign(t=time).groupby(SERIES)["t"].transform(f).to_numpy() for f in ("min", np.ptp))
        return np.asarray(np.minimum(((time - start) / span * STRETCHES).astype(np.int64), STRETCHES - 1))
    return np.zeros(len(rows), dtype=np.int64)


def may_know(split: Split, known: pd.DataFrame, fold: pd.DataFrame, *, same_flight: bool) -> BoolArray:
    """Rows (n,) of ``known`` that a prediction of one fold may use.

    Parameters
    ----------
    split : {"flights", "sectors", "blocks", "stretches"}
    known : DataFrame
        Rows that may be learned from.
    fold : DataFrame
        Rows of one fold.
    same_flight : bool
        Both are of one flight.
    """
    if split == "sectors":
        width = 360.0 / SECTORS
        middle = (np.floor(_bearing_deg(fold)[0] / width) + 0.5) * width
        from_middle = np.abs((_bearing_deg(known) - middle + 180.0) % 360.0 - 180.0)
        return np.asarray(from_middle > 0.5 * width + SECTOR_GUARD_DEG)
    if not same_flight:
        return np.ones(len(known), dtype=np.bool_)
    if split == "blocks":
        place, first = (rows[["east_m", "north_m"]].to_numpy() for rows in (known, fold))
        middle = (np.floor(first[0] / BLOCK_M) + 0.5) * BLOCK_M
        return np.asarray((np.abs(place - middle) > 0.5 * BLOCK_M + BLOCK_GUARD_M).any(axis=1))
    time, asked = _seconds(known), _seconds(fold)
    low, high = asked.min(), asked.max()
    return np.asarray((time < low - STRETCH_GUARD_S) | (time > high + STRETCH_GUARD_S))
