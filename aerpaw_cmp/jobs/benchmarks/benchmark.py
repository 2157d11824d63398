"""The ``benchmark`` job: frozen splits of published flights, predictions scored from plain CSV files."""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cached_property
from importlib import resources
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from ...common.errors import InputError, UsageError
from ...common.files import read_input
from ...common.jsonable import fields_of, json_safe
from ...common.units import BoolArray, FloatArray, IntArray
from ...common.yamlfile import StrictModel, load_yaml
from ...compare.entries import LevelSeries, intervals, level_scores
from ...compare.forecast import constant_forecast, score_forecast
from ...compare.learning.calibration import Observed
from ...flight.data import FlightData, load_data
from ...flight.settings import FlightFile
from ..learning.calibrate import observe
from ..learning.calibrate_rank import RankSamples, rank_samples

_LARGEST_ENTRY = 2**30

SECTORS, SECTOR_GUARD_DEG = 6, 10.0
BLOCK_M, BLOCK_GUARD_M = 300.0, 20.0
STRETCHES, STRETCH_GUARD_S = 8, 20.0

KEY = ["task", "flight", "tower", "channel", "time"]
RANKS = ["p_rank1", "p_rank2", "p_rank3", "p_rank4"]
BASELINES = ("free_space", "log_distance")

_Split = Literal["flights", "sectors", "blocks", "stretches"]


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

    @property
    def url(self) -> str:
        """URL from which the file can be fetched."""
        from urllib.parse import quote

        return f"https://raw.githubusercontent.com/{self.repository}/HEAD/{quote(self.path)}"


class Task(StrictModel):
    """Definition of a task: what is predicted from what."""

    title: str
    kind: Literal["level", "rank"] = "level"
    split: _Split = "flights"
    train: list[str] = Field(default_factory=list)
    test: Annotated[list[str], Field(min_length=1)]

    @property
    def own_offset(self) -> bool:
        """True if each series is scored about its own mean error: its own flight is not among what is known."""
        return self.split in ("flights", "sectors")

    @property
    def rule(self) -> str:
        """Rule in words: what an entrant may know and how levels are counted."""
        known = {
            "flights": "the training flights",
            "sectors": f"the training flights outside the sample's sector of {360 // SECTORS} degrees at the tower "
            f"(and {SECTOR_GUARD_DEG:g} degrees beside it)",
            "blocks": f"the training flights, and the test flight outside the sample's block of {BLOCK_M:g} m "
            f"(and {BLOCK_GUARD_M:g} m around it)",
            "stretches": f"the flight outside the sample's {STRETCHES}th of its time (and {STRETCH_GUARD_S:g} s "
            "beside it)",
        }[self.split]
        offset = (
            "Levels count about the mean error of each flight, tower and channel."
            if self.own_offset
            else "Levels count as they are."
        )
        scoring = offset if self.kind == "level" else "Scored is the probability of each rank."
        return f"Known: {known}. {scoring}"


class Manifest(StrictModel):
    """Files, flights and tasks of one version of the benchmark."""

    version: int
    files: dict[str, FileEntry]
    flights: dict[str, dict[str, Any]]
    """Each the content of a flight.yaml whose ``path`` names a file of this manifest."""
    tasks: dict[str, Task]


def load_manifest(path: Path | None = None) -> Manifest:
    """The packaged manifest, or another one."""
    if path is not None:
        return load_yaml(path, Manifest)
    with resources.as_file(resources.files("aerpaw_cmp.jobs.benchmarks") / "benchmark.yaml") as packaged:
        return load_yaml(packaged, Manifest)


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
    """SHA-256 of a file after unpacking; empty where its size is none of those wanted."""
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


@dataclass(frozen=True)
class Bench:
    """A manifest with the data at hand."""

    manifest: Manifest
    folder: Path

    @cached_property
    def places(self) -> dict[str, Path]:
        """Paths of the files, by name."""
        return locate(self.manifest, self.folder)

    @cached_property
    def _loaded(self) -> dict[str, Any]:
        return {}

    def logs_of(self, flight: str) -> list[str]:
        """Names of a flight's files."""
        return [log["path"] for log in self.manifest.flights[flight]["logs"]]

    def missing(self, flight: str) -> list[str]:
        """Files of a flight that are not at hand."""
        return [name for name in self.logs_of(flight) if name not in self.places]

    def data(self, flight: str) -> FlightData:
        """A flight, read once."""
        if flight not in self._loaded:
            content = self.manifest.flights[flight]
            logs = [{**log, "path": str(self.places[log["path"]].resolve())} for log in content["logs"]]
            settings = FlightFile.model_validate({**content, "flight": {"name": flight}, "logs": logs})
            self._loaded[flight] = load_data(settings, self.folder)
        return self._loaded[flight]  # type: ignore[no-any-return]

    def observed(self, flight: str) -> list[Observed]:
        """Level samples of a flight, known ones alone."""
        key = f"level {flight}"
        if key not in self._loaded:
            parts, _ = observe([self.data(flight)])
            self._loaded[key] = [o.part(np.isfinite(o.samples.residual_db)) for o in parts]
        return self._loaded[key]  # type: ignore[no-any-return]

    def ranks(self, flight: str) -> list[RankSamples]:
        """Rank reports of a flight, those with CSI alone."""
        data = self.data(flight)
        samples = (rank_samples(data, series) for series in data.rank)
        return [sample.part(sample.rank >= 1) for sample in samples]

    def skipped(self, task: str, *, training: bool) -> list[str]:
        """Files that a task lacks, each with its source; empty where it can be run."""
        spec = self.manifest.tasks[task]
        absent = [name for flight in (*spec.test, *(spec.train if training else ())) for name in self.missing(flight)]
        return [
            f"{name}: {self.manifest.files[name].path} of {self.manifest.files[name].repository}"
            for name in dict.fromkeys(absent)
        ]

    def tests(self, task: str) -> list[str]:
        """Test flights at hand."""
        return [flight for flight in self.manifest.tasks[task].test if not self.missing(flight)]


# --- splits --------------------------------------------------------------------------------------------------------


def _folds_of(split: _Split, observed: Observed) -> IntArray:
    """Fold (n,) of each test sample: those of one fold are predicted together."""
    samples = observed.samples
    if split == "sectors":
        azimuth = np.degrees(np.arctan2(samples.at_tower[:, 0], samples.at_tower[:, 1])) % 360.0
        return np.asarray(azimuth // (360.0 / SECTORS), dtype=np.int64)
    if split == "blocks":
        cell = np.floor(samples.position_m[:, :2] / BLOCK_M).astype(np.int64)
        return np.asarray(np.unique(cell, axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)
    if split == "stretches":
        span = samples.time_s - samples.time_s[0]
        return np.asarray(np.minimum((span / span[-1] * STRETCHES).astype(np.int64), STRETCHES - 1))
    return np.zeros(len(samples), dtype=np.int64)


def _may_know(split: _Split, known: Observed, fold: Observed, *, same_flight: bool) -> BoolArray:
    """Samples of ``known`` that a prediction of one fold may use.

    Parameters
    ----------
    split : {"flights", "sectors", "blocks", "stretches"}
    known : Observed
        A series that may be learned from.
    fold : Observed
        Samples of one fold.
    same_flight : bool
        Both are of one flight.

    Returns
    -------
    (n,) bool
    """
    if split == "sectors":
        azimuth, fold_azimuth = (np.arctan2(o.samples.at_tower[:, 0], o.samples.at_tower[:, 1]) for o in (known, fold))
        width = 2.0 * np.pi / SECTORS
        middle = (np.floor(fold_azimuth[0] % (2 * np.pi) / width) + 0.5) * width
        from_middle = np.abs((azimuth - middle + np.pi) % (2.0 * np.pi) - np.pi)
        return np.asarray(from_middle > 0.5 * width + np.radians(SECTOR_GUARD_DEG))
    if not same_flight:
        return np.ones(len(known.samples), dtype=np.bool_)
    if split == "blocks":
        place, cell = known.samples.position_m[:, :2], np.floor(fold.samples.position_m[0, :2] / BLOCK_M)
        return np.asarray((np.abs(place - (cell + 0.5) * BLOCK_M) > 0.5 * BLOCK_M + BLOCK_GUARD_M).any(axis=1))
    low, high = fold.samples.time_s[[0, -1]]
    return np.asarray((known.samples.time_s < low - STRETCH_GUARD_S) | (known.samples.time_s > high + STRETCH_GUARD_S))


@dataclass(frozen=True, slots=True)
class Question:
    """One fold of a task: what is known and what is asked. ``rows`` (n,) of each target series of the flight."""

    train: list[Observed]
    targets: list[Observed]
    rows: list[IntArray]


def questions(bench: Bench, task: str, flight: str) -> Iterator[Question]:
    """The folds of one test flight."""
    spec = bench.manifest.tasks[task]
    tests = bench.observed(flight)
    folds = [_folds_of(spec.split, o) for o in tests]
    for fold in np.unique(np.concatenate(folds)):
        rows = [np.flatnonzero(f == fold) for f in folds]
        targets = [o.part(r) for o, r in zip(tests, rows, strict=True)]
        some = next(o for o in targets if len(o.samples))
        train = [
            o.part(_may_know(spec.split, o, some, same_flight=False))
            for name in spec.train
            for o in bench.observed(name)
        ]
        if not spec.own_offset:
            train += [o.part(_may_know(spec.split, o, some, same_flight=True)) for o in tests]
        yield Question([o for o in train if len(o.samples)], targets, rows)


# --- tables --------------------------------------------------------------------------------------------------------


def utc_texts(start: np.datetime64 | None, time_s: FloatArray) -> list[str]:
    """Instants (n,) as ISO 8601 text to the microsecond, the key of a row."""
    assert start is not None
    instant = start.astype("datetime64[ns]") + (time_s * 1e9).round().astype("timedelta64[ns]")
    return [f"{t}Z" for t in np.datetime_as_string(instant, unit="us")]


def keys(
    task: str, flight: str, tower: str, channel: str, start: np.datetime64 | None, time_s: FloatArray
) -> pd.DataFrame:
    """Columns by which rows are told apart, a row per sample.

    Parameters
    ----------
    task, flight, tower, channel : str
        The same in every row.
    start : datetime64[ns], optional
        From which the times count.
    time_s : ndarray (n,)

    Returns
    -------
    DataFrame
        Columns :data:`KEY`.
    """
    names = dict(zip(KEY, (task, flight, tower, channel, utc_texts(start, time_s)), strict=True))
    table: pd.DataFrame = pd.DataFrame(names)
    return table


def truth(bench: Bench, task: str, *, training: bool = False) -> pd.DataFrame:
    """Rows of a task: key, fold, geometry, and ``measured`` (level in dB, or rank).

    Parameters
    ----------
    bench : Bench
    task : str
    training : bool
        The training flights in place of the test flights.
    """
    spec = bench.manifest.tasks[task]
    flights = [f for f in spec.train if not bench.missing(f)] if training else bench.tests(task)
    of = _rank_rows if spec.kind == "rank" else _level_rows
    parts = [frame for flight in flights for frame in of(bench, task, flight)]
    if not parts:
        parts = [pd.DataFrame(columns=[*KEY, "fold", "measured"])]
    table: pd.DataFrame = pd.concat(parts, ignore_index=True).drop_duplicates(KEY, ignore_index=True)
    return table


def _level_rows(bench: Bench, task: str, flight: str) -> Iterator[pd.DataFrame]:
    data, split = bench.data(flight), bench.manifest.tasks[task].split
    for o in bench.observed(flight):
        s = o.samples
        series = next(r for r in data.rss if (r.tower, r.channel) == (s.tower, s.channel))
        frame = keys(task, flight, s.tower, s.channel, o.start, s.time_s)
        rotation = data.poses_at(np.array([t.removesuffix("Z") for t in frame["time"]], "datetime64[ns]")).rotation
        tower = data.site.towers[s.tower].position_m if o.tower_m is None else o.tower_m.T
        yield _geometry(frame, s.position_m, rotation, np.round(tower, 3)).assign(
            fold=_folds_of(split, o),
            **dict(zip(("body_forward", "body_left", "body_up"), s.at_uav.T.round(6), strict=True)),
            carrier_hz=series.link.carrier_hz,
            measured=s.residual_db + o.free_space_db,
        )


def _rank_rows(bench: Bench, task: str, flight: str) -> Iterator[pd.DataFrame]:
    for item in bench.ranks(flight):
        frame = keys(task, flight, item.tower, "rank", np.datetime64(0, "ns"), item.time_s)
        yield _geometry(frame, item.poses.position_m, item.poses.rotation, item.tower_m).assign(
            fold=0, carrier_hz=item.link.carrier_hz, measured=item.rank.astype(np.int64)
        )


def _geometry(frame: pd.DataFrame, position: FloatArray, rotation: FloatArray, tower: Iterable[Any]) -> pd.DataFrame:
    """Add position, attitude (aircraft: yaw clockwise from north, nose up, right wing down positive) and tower."""
    nose, left, up = (rotation[:, :, i] for i in range(3))
    placed: pd.DataFrame = frame.assign(
        **{name: position[:, i].round(3) for i, name in enumerate(("east_m", "north_m", "up_m"))},
        yaw_deg=(np.degrees(np.arctan2(nose[:, 0], nose[:, 1])) % 360.0).round(3),
        pitch_deg=np.degrees(np.arcsin(np.clip(nose[:, 2], -1, 1))).round(3),
        roll_deg=np.degrees(np.arctan2(left[:, 2], up[:, 2])).round(3),
        **dict(zip(("tower_east_m", "tower_north_m", "tower_up_m"), tower, strict=True)),
    )
    return placed


# --- entries -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Entry:
    """Predictions of one entrant: ``frame`` by :data:`KEY`, and what its head says (``entrant``, ``who``, ...)."""

    frame: pd.DataFrame
    head: Mapping[str, str]
    sha256: str


def read_entry(path: Path) -> Entry:
    """A predictions.csv, with lines ``# key: value`` before its header.

    Raises
    ------
    InputError
        Unreadable, no table, columns missing, rows twice, values that are no numbers.
    """
    try:
        text = read_input(path, _LARGEST_ENTRY, "a CSV of predictions").decode()
    except UnicodeDecodeError:
        raise InputError("not a text file", expected="a CSV of predictions in UTF-8", path=path) from None
    lines = text.splitlines()
    count = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    head = {k.strip(): v.strip() for k, _, v in (line[1:].partition(":") for line in lines[:count])}
    try:
        table = StringIO("\n".join(lines[count:]))
        frame = pd.read_csv(table, dtype=dict.fromkeys(KEY, str), keep_default_na=False, low_memory=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise InputError(f"no table: {error}", expected=f"columns {', '.join(KEY)}, level_db", path=path) from None
    if absent := [name for name in KEY if name not in frame]:
        raise InputError(f"no column {absent[0]!r}", expected=f"columns {', '.join(KEY)}, level_db", path=path)
    values = [name for name in ("level_db", "sd_db", *RANKS) if name in frame]
    if not values or ("level_db" not in frame and not set(RANKS) <= set(frame)):
        raise InputError("no predictions", expected=f"level_db (and sd_db), or {', '.join(RANKS)}", path=path)
    for name in values:
        number = pd.to_numeric(frame[name].replace("", "nan"), errors="coerce")
        wrong = number.isna() & ~frame[name].astype(str).str.strip().str.lower().isin(["", "nan"])
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{name} {str(frame[name].iloc[row])!r}", expected="a number", path=path, line=count + row + 2
            )
        frame[name] = number
    twice = frame.duplicated(KEY)
    if twice.any():
        row = int(np.flatnonzero(twice)[0])
        raise InputError(
            f"{int(twice.sum())} rows stand twice, {frame['flight'].iloc[row]} {frame['time'].iloc[row]} first",
            expected="one row per task, flight, tower, channel and time",
            path=path,
            line=count + row + 2,
        )
    return Entry(frame, head, hashlib.sha256(text.encode()).hexdigest())


def check_training(bench: Bench, entry: Entry, tasks: Sequence[str]) -> None:
    """UsageError where the entrant declares a test file among what it was trained on."""
    declared = set(entry.head.get("trained_on", "").replace(",", " ").split())
    test_flights = [(task, flight) for task in tasks for flight in bench.manifest.tasks[task].test]
    for task, flight in test_flights if declared else ():
        files = [bench.manifest.files[name] for name in bench.logs_of(flight)]
        known = declared & {digest for file in files for digest in (file.sha256, *file.also)}
        if known and bench.manifest.tasks[task].own_offset:
            raise UsageError(
                f"trained on {flight}, a test flight of {task}",
                expected="predictions of a model that never saw the test flights",
                cause="'# trained_on:' at the top of the file names its SHA-256",
            )


def score_task(
    bench: Bench, task: str, entry: Entry, baselines: Mapping[str, Entry], *, accept_levels: bool = False
) -> dict[str, Any]:
    """Scores of one task.

    Parameters
    ----------
    bench : Bench
    task : str
    entry : Entry
    baselines : mapping of str to Entry
        Whose RMSE is compared on the same blocks.
    accept_levels : bool
        Skip the test of sign and unit.

    Returns
    -------
    dict
        Scores, intervals and counts under stable names.

    Raises
    ------
    UsageError
        Rows missing, unknown rows, levels of the wrong sign or unit.
    """
    table = truth(bench, task)
    if bench.manifest.tasks[task].kind == "rank":
        return _score_rank(bench, task, _joined(task, table, entry, RANKS))
    series = _level_series(bench, task, table, entry)
    if not accept_levels:
        _check_levels(task, table, entry)
    peers = {name: _level_series(bench, task, table, peer) for name, peer in baselines.items() if peer is not entry}
    return {**level_scores(series), **intervals(series, peers)}


def _joined(task: str, table: pd.DataFrame, entry: Entry, values: Sequence[str]) -> pd.DataFrame:
    """The rows of the truth with the predictions beside them."""
    predicted = entry.frame[entry.frame["task"] == task]
    if absent := [name for name in values if name not in predicted]:
        raise UsageError(f"{task}: no column {absent[0]!r}", expected=f"{', '.join(values)} beside {', '.join(KEY)}")
    joined: pd.DataFrame = table.merge(predicted[[*KEY, *values]], on=KEY, how="left", validate="one_to_one")
    lost = ~np.isfinite(joined[list(values)]).all(axis=1)
    if lost.any():
        first = joined[lost].iloc[0]
        raise UsageError(
            f"{task}: {int(lost.sum())} of {len(joined)} rows have no prediction, first {first['flight']} "
            f"{first['tower']} {first['channel']} {first['time']}",
            expected="a number for every row of 'aerpaw-cmp benchmark template'",
            cause="other times or channels, rows left out, or a flight that was not predicted",
        )
    return joined


def _level_series(bench: Bench, task: str, table: pd.DataFrame, entry: Entry) -> list[LevelSeries]:
    has_sd = "sd_db" in entry.frame and bool(entry.frame.loc[entry.frame["task"] == task, "sd_db"].notna().all())
    joined = _joined(task, table, entry, ["level_db", "sd_db"] if has_sd else ["level_db"])
    if has_sd and not (joined["sd_db"] > 0).all():
        raise UsageError(f"{task}: a standard deviation of {joined['sd_db'].min():g} dB", expected="sd_db above 0")
    own_offset = bench.manifest.tasks[task].own_offset
    return [
        LevelSeries(
            name=" ".join(map(str, name)),
            time_s=(pd.to_datetime(rows["time"]) - pd.to_datetime(rows["time"].iloc[0])).dt.total_seconds().to_numpy(),
            measured_db=rows["measured"].to_numpy(np.float64),
            level_db=rows["level_db"].to_numpy(np.float64),
            sd_db=rows["sd_db"].to_numpy(np.float64) if has_sd else None,
            own_offset=own_offset,
        )
        for name, rows in joined.groupby(["flight", "tower", "channel"], sort=False)
    ]


def _check_levels(task: str, table: pd.DataFrame, entry: Entry) -> None:
    """UsageError where levels rise with distance, or are spread as no dB are."""
    joined = _joined(task, table, entry, ["level_db"])
    places = [joined[f"{axis}_m"] - joined[f"tower_{axis}_m"] for axis in ("east", "north", "up")]
    distance = np.log10(np.maximum(np.sqrt(sum(p**2 for p in places)), 1.0))
    spread, level = float(joined["level_db"].std()), joined["level_db"]
    if spread < 1e-9:
        return  # a constant is an honest model
    slope = float(np.polyfit(distance, level, 1)[0]) if float(distance.std()) > 1e-6 else 0.0
    measured = float(np.polyfit(distance, joined["measured"], 1)[0]) if float(distance.std()) > 1e-6 else 0.0
    if slope > 5.0 and measured < 0.0:
        raise UsageError(
            f"{task}: predicted levels rise by {slope:.0f} dB per decade of distance",
            expected="received levels, which fall",
            cause="path loss in place of a level; --accept-levels where it is meant",
        )
    if spread < 0.02 * float(joined["measured"].std()) or spread > 50.0 * float(joined["measured"].std()):
        raise UsageError(
            f"{task}: predicted levels are spread by {spread:.2g}, measured ones by {joined['measured'].std():.2g} dB",
            expected="dB",
            cause="milliwatts or amplitudes; --accept-levels where it is meant",
        )


def _score_rank(bench: Bench, task: str, joined: pd.DataFrame) -> dict[str, Any]:
    p = joined[RANKS].to_numpy(np.float64)
    if (p < 0.0).any() or not np.allclose(p.sum(axis=1), 1.0, atol=1e-3):
        raise UsageError(f"{task}: probabilities that do not add up to 1", expected=", ".join(RANKS))
    train = bench.manifest.tasks[task].train
    known = [samples.rank for flight in train if not bench.missing(flight) for samples in bench.ranks(flight)]
    constant = constant_forecast(np.concatenate(known)) if known else np.full(4, 0.25)
    decided = p.argmax(axis=1) + 1
    score = score_forecast(joined["measured"].to_numpy(np.float64), p / p.sum(axis=1)[:, None], decided, constant)
    return {name: tuple(v) if isinstance(v, np.ndarray) else v for name, v in fields_of(score).items()}


# --- the table of results ------------------------------------------------------------------------------------------


def leaderboard_row(bench: Bench, entry: Entry, scores: Mapping[str, Any], version: str) -> dict[str, Any]:
    """A row of leaderboard.json: who, when, which bytes, which scores.

    Parameters
    ----------
    bench : Bench
    entry : Entry
    scores : mapping of task to scores
    version : str
        Of this package.

    Returns
    -------
    dict
    """
    used = sorted({f for task in scores for flight in bench.tests(task) for f in bench.logs_of(flight)})
    return {
        "entrant": entry.head.get("entrant", "unnamed"),
        "who": entry.head.get("who", ""),
        "date": datetime.now(timezone.utc).date().isoformat(),
        "benchmark": bench.manifest.version,
        "aerpaw_cmp": version,
        "predictions_sha256": entry.sha256,
        "test_files_sha256": {name: bench.manifest.files[name].sha256 for name in used},
        "scores": json_safe(scores),
    }


def read_leaderboard(path: Path) -> list[dict[str, Any]]:
    """Rows of a leaderboard.json; none where there is no such file.

    Raises
    ------
    InputError
        A file that is no leaderboard.
    """
    if not path.exists():
        return []
    try:
        rows = json.loads(read_input(path, _LARGEST_ENTRY, "a leaderboard"))
        if not isinstance(rows, list) or not all(isinstance(r, dict) and "scores" in r for r in rows):
            raise ValueError("no list of rows")
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"no leaderboard: {error}", expected="leaderboard.json of this benchmark", path=path) from None
    return rows
