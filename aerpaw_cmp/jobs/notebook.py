"""The Python interface of a flight: ``open_flight("flight.yaml")`` and the objects that it returns."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ..common.cf import library
from ..common.errors import UsageError, from_python
from ..common.text import counted, html_table
from ..common.units import ComplexArray, FloatArray
from ..common.yamlfile import parse_yaml
from ..compare.result import FlightResult
from ..flight.data import FlightData, gather, load_data, rank_positions
from ..flight.drafting.draft import draft, flights_by_name
from ..flight.gains import with_learned
from ..flight.replay import FlightReplay, Replayed, replay_flight
from ..flight.settings import FlightFile, load_flight, overridden
from ..logs.flight_file import is_flight_file
from ..logs.ingest import ingest
from ..propagation.geometry import PathSet
from ..site.site import Site
from .compare_flight import compare_flight
from .options import RunOptions

# Tower and channel of an RSS series. The channel of a rank series is ``"rank"``.
Series = tuple[str, str]


@from_python
def open_flight(
    path: str | Path,
    *,
    logs_root: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    flight: str | None = None,
) -> Flight:
    """Read a flight.yaml and its logs, or a flight.h5, whose settings are then drafted.

    Parameters
    ----------
    path : path
        A flight.yaml, or a flight file (HDF5) of ``ingest -o`` or ``Logs.write``.
    logs_root : path, optional
        Folder to which relative paths of logs refer. Default: the folder of the flight file.
    overrides : mapping, optional
        Changed keys of the flight file in dotted form: ``{"rt.max_depth": 1, "rss.lag": "off"}``.
    flight : str, optional
        Name of the flight, for a flight file with several flights.

    Returns
    -------
    Flight

    Raises
    ------
    UsageError, InputError
        If the flight file or a log is wrong. The message states the likely cause.

    Examples
    --------
    >>> flight = open_flight("sample_logs/flight.yaml")  # doctest: +SKIP
    >>> flight.compare().to_frame()  # doctest: +SKIP
    """
    file = Path(path).expanduser()
    root = None if logs_root is None else Path(logs_root).expanduser()
    drafted = file.is_file() and is_flight_file(file)
    if flight is not None and not drafted:
        raise UsageError("flight=NAME with a flight.yaml", expected="a flight file of several flights", path=file)
    written = overridden(_drafted(file, flight) if drafted else load_flight(file), overrides or {})
    data = load_data(with_learned(written, file.parent), file.parent, root)
    for warning in data.warnings:
        logging.getLogger("aerpaw_cmp.flight").warning(warning)
    changed = ("the draft of its flight file",) if drafted else ()
    return Flight(file, data, root, written=written, changed=(*changed, *(overrides or ())))


def _drafted(file: Path, flight: str | None) -> FlightFile:
    """Return the settings that ``ingest --draft`` would write for a flight of a flight file."""
    known = flights_by_name(ingest(file))
    if flight is None and len(known) > 1:
        raise UsageError(f"{len(known)} flights", expected=f"flight='NAME', one of {', '.join(known)}", path=file)
    if flight is not None and flight not in known:
        raise UsageError(f"no flight {flight!r}", expected=f"one of {', '.join(known)}", path=file)
    name = flight or next(iter(known))
    text, _ = draft(known[name].files, file.parent, flight=known[name])
    return parse_yaml(text, FlightFile)


@from_python
@dataclass(repr=False, eq=False)
class Flight:
    """A checked flight.yaml with its logs. The flight is replayed only on request.

    Parameters
    ----------
    path : Path
        Path of the flight file.
    data : FlightData
        Settings, site, logs, track and series.
    logs_root : Path, optional
        Folder to which relative paths of logs refer.
    written : FlightFile, optional
        Settings of the flight file before learned antennas are added. Default: those of ``data``.
    changed : tuple of str
        Keys whose values differ from the file.
    """

    path: Path
    data: FlightData
    logs_root: Path | None = None
    written: FlightFile | None = None
    changed: tuple[str, ...] = ()

    @property
    def settings(self) -> FlightFile:
        """The settings of the flight file, including defaults."""
        return self.data.settings

    @property
    def site(self) -> Site:
        """Towers, buildings, trees and heights."""
        return self.data.site

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings that concern every number of the flight."""
        return self.data.warnings

    @cached_property
    def track(self) -> pd.DataFrame:
        """Telemetry as poses: ``time east_m north_m up_m heading_deg attitude_known``, one row per time."""
        if self.data.track is None:
            return _together([], ["time", "east_m", "north_m", "up_m", "heading_deg", "attitude_known"])
        times = self._telemetry_times()
        poses = self.data.track.pose_at(times)
        frame = pd.DataFrame(poses.position_m, columns=["east_m", "north_m", "up_m"])
        frame.insert(0, "time", _utc(times))
        frame["heading_deg"] = poses.heading_deg
        frame["attitude_known"] = poses.attitude_known
        posed: pd.DataFrame = frame[poses.valid].reset_index(drop=True)
        return posed

    @cached_property
    def rss(self) -> pd.DataFrame:
        """Measured levels: ``time tower channel unit measured_db east_m north_m up_m``. NaN if there is no signal."""
        frames = []
        for series in self.data.rss:
            position = np.full((len(series.time), 3), np.nan)
            if self.data.track is not None:
                position = self.data.track.pose_at(series.time).position_m
            level = {"measured_db": series.measured_db, **_place(position)}
            what = {"tower": series.tower, "channel": series.channel, "unit": series.unit}
            frames.append(pd.DataFrame({"time": _utc(series.time), **what, **level}))
        return _together(frames, ["time", "tower", "channel", "unit", "measured_db", "east_m", "north_m", "up_m"])

    @cached_property
    def rank(self) -> pd.DataFrame:
        """Reported ranks: ``time tower rank sinr_db east_m north_m up_m``. NaN if the modem had no CSI."""
        frames = []
        for series in self.data.rank:
            position, _ = rank_positions(series, self.data.track)
            columns = {"tower": series.tower, "rank": series.rank, "sinr_db": series.sinr_db, **_place(position)}
            frames.append(pd.DataFrame({"time": _utc(series.time), **columns}))
        return _together(frames, ["time", "tower", "rank", "sinr_db", "east_m", "north_m", "up_m"])

    def replay(self, engine: str | None = None, **overrides: Any) -> ReplayedFlight:
        """Ray-trace every series along the flight.

        Parameters
        ----------
        engine : {"image", "sionna"}, optional
            Default: the engine of the flight file.
        overrides
            Keys below ``rt`` of the flight file: ``max_depth=1``, ``foliage="none"``, ``attitude="logged"``. Write
            other keys as a mapping: ``**{"rss.lag": "off"}``.

        Raises
        ------
        UsageError
            If a key does not exist, or a value has the wrong type.
        """
        keys = {key if "." in key else f"rt.{key}": value for key, value in overrides.items()}
        if engine is not None:
            keys["rt.engine"] = engine
        # apply overrides first, because learned antennas must fit the carrier in them
        settings = with_learned(overridden(self.written or self.data.settings, keys), self.path.parent)
        data = gather(settings, self.path.parent, self.data.files, self.logs_root) if keys else self.data
        return ReplayedFlight(data, replay_flight(data))

    def compare(self, engine: str | None = None, **overrides: Any) -> Comparison:
        """Replay and compare. The arguments are those of :meth:`replay`."""
        return self.replay(engine, **overrides).compare()

    def report(self, folder: str | Path, *, force: bool = False, **options: Any) -> Path:
        """Write the report of ``aerpaw-cmp report``, and return the path of its page.

        Parameters
        ----------
        folder : path
            Folder of the report. A report of this tool is replaced. Other files are replaced only with ``force``.
        force : bool
        options
            Fields of :class:`aerpaw_cmp.jobs.run.ReportOptions`.

        Raises
        ------
        UsageError
            If this flight was opened with overrides, because a report describes the flight file.
        """
        if self.changed:
            raise UsageError(
                f"a report of {self.path.name} with other settings ({', '.join(self.changed)})",
                expected="an unchanged flight file",
                cause="open_flight(overrides=...): write the overrides into a separate flight.yaml",
            )
        from .run import ReportOptions, run_report

        out = Path(folder)
        run_report(self.path, ReportOptions(**options), RunOptions(out=out, logs_root=self.logs_root, force=force))
        return out / "report.html"

    def channel(self, **options: Any) -> Any:
        """Return paths, channel matrices and calibrated levels along the track, as ``aerpaw-cmp channel`` writes them.

        Parameters
        ----------
        options
            Fields of :class:`aerpaw_cmp.jobs.channel.ChannelOptions`.

        Returns
        -------
        xarray.Dataset
        """
        from ..report.channel import channel_dataset
        from .channel import ChannelOptions, channel_parts

        (channel,) = channel_parts(self.data, ChannelOptions(**options))
        return channel_dataset(channel).to_xarray()

    def plot(self, axes: Any = None) -> Any:
        """Draw trajectory and towers from above on matplotlib axes (default: new axes), and return the axes."""
        axes = axes if axes is not None else _new_axes()
        axes.plot(self.track.east_m, self.track.north_m, label=self.settings.flight.name)
        for name, tower in self.site.towers.items():
            axes.plot(*tower.position_m[:2], "^", label=name)
        axes.set(xlabel="East [m]", ylabel="North [m]", aspect="equal")
        axes.legend()
        return axes

    def _telemetry_times(self) -> Any:
        frames = [s.frame for f in self.data.files for s in f.result.streams if s.kind == "telemetry"]
        times = pd.concat([frame["time"] for frame in frames]).dropna().to_numpy("datetime64[ns]")
        track = self.data.track
        assert track is not None
        inside = (times.view("int64") >= track.start_ns) & (times.view("int64") <= track.end_ns)
        # two logs of one vehicle may have equal times, and the time axis must increase
        return np.unique(times[inside])

    def __repr__(self) -> str:
        """Return name, series and track in one line."""
        name, span = self.settings.flight.name, counted(len(self.track), "pose") if len(self.track) else "no track"
        return f"Flight({name!r}: {len(self.data.rss)} RSS series, {len(self.data.rank)} rank series, {span})"

    def _repr_html_(self) -> str:
        """Return a table of the series for notebooks."""
        rows = [(s.tower, s.channel, f"RSS [{s.unit}]", len(s.time)) for s in self.data.rss]
        rows += [(s.tower, "", "rank", len(s.time)) for s in self.data.rank]
        return html_table(("tower", "channel", "quantity", "samples"), rows, self.settings.flight.name)


@from_python
@dataclass(repr=False, eq=False)
class ReplayedFlight:
    """A flight, ray-traced at its samples.

    Parameters
    ----------
    data : FlightData
    replays : FlightReplay
        Poses, paths and fields of every series.
    """

    data: FlightData
    replays: FlightReplay

    @property
    def series(self) -> dict[Series, Replayed]:
        """The replay of every series, RSS before rank."""
        keys = [(s.tower, s.channel) for _, s in self.data.series]
        return dict(zip(keys, self.replays.all, strict=True))

    @property
    def rss_dbm(self) -> dict[Series, FloatArray]:
        """Simulated level (n,) [dBm] at every sample of a series. NaN if there is no pose or no path."""
        return {key: replayed.spread(replayed.replay.rss_dbm[:, 0]) for key, replayed in self.series.items()}

    @property
    def h(self) -> dict[Series, ComplexArray]:
        """Channel matrices (poses, n_rx, n_tx), complex128, at known poses."""
        return {key: replayed.replay.h[:, 0] for key, replayed in self.series.items()}

    @property
    def paths(self) -> dict[Series, PathSet]:
        """Paths of each series. ``pose`` is the index among known poses."""
        return {key: replayed.replay.paths for key, replayed in self.series.items()}

    def to_xarray(self) -> Any:
        """Return levels and channel matrices on a time axis.

        Returns
        -------
        xarray.DataTree
            A node ``<tower>/<channel>`` per series. ``time`` contains the UTC times of samples with a known pose.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        times = {(s.tower, s.channel): s.time for _, s in self.data.series}
        nodes = {}
        for key, replayed in self.series.items():
            data = replayed.replay.to_xarray().rename(pose="time")
            place = {name: ("time", values) for name, values in _place(replayed.poses.position_m).items()}
            nodes[_node(key)] = data.assign_coords(time=times[key][replayed.valid], **place)
        return _tree(nodes)

    def compare(self) -> Comparison:
        """Compare every series: offsets, errors, baselines and ranks."""
        return Comparison(compare_flight(self.data, self.replays))

    def __repr__(self) -> str:
        """Return one line per series."""
        return "\n".join(["ReplayedFlight", *(f"  {' '.join(k)}: {v.replay!r}" for k, v in self.series.items())])


@from_python
@dataclass(repr=False, eq=False)
class Comparison:
    """The numbers of the comparison of a flight.

    Parameters
    ----------
    result : FlightResult
        All numbers as records (:mod:`aerpaw_cmp.compare.result`).
    """

    result: FlightResult

    def to_frame(self) -> pd.DataFrame:
        """Return one row per RSS series, with its baselines.

        Columns: ``tower channel n offset_db rmse_db rmse_low_db rmse_high_db correlation at_search_edge`` and
        ``<baseline>_rmse_db``.
        """
        rows = [
            {
                "tower": item.tower,
                "channel": item.channel,
                "n": item.score.n,
                "offset_db": item.score.offset_db,
                "rmse_db": item.score.rmse_db,
                **dict(zip(("rmse_low_db", "rmse_high_db"), item.score.rmse_ci95_db, strict=True)),
                "correlation": item.score.correlation,
                "at_search_edge": item.score.at_edge,
                **{f"{name}_rmse_db": fit.rmse_db for name, fit in item.baselines.items()},
            }
            for item in self.result.rss
        ]
        table: pd.DataFrame = pd.DataFrame(rows)
        return table

    def rank_to_frame(self) -> pd.DataFrame:
        """Return one row per tower and K: ``tower k n agreement kappa total_variation wasserstein``."""
        rows = [
            {"tower": item.tower, "k": k, "n": item.score.n, "agreement": fit.agreement, "kappa": fit.kappa,
             "total_variation": fit.total_variation, "wasserstein": fit.wasserstein}
            for item in self.result.rank
            for k, fit in item.score.simulated.items()
        ]  # fmt: skip
        table: pd.DataFrame = pd.DataFrame(rows)
        return table

    def to_xarray(self) -> Any:
        """Return measured and simulated levels and ranks on a time axis.

        Returns
        -------
        xarray.DataTree
            A node ``<tower>/<channel>`` per RSS series and ``<tower>/rank`` per rank series. Times are UTC.

            - RSS: ``measured_db``, ``calibrated_db`` (measured plus the fitted offset), ``simulated_dbm``, and
              ``residual_db`` (calibrated minus simulated, NaN if not compared).
            - Rank: ``measured``, and ``simulated`` by ``k``.

        Raises
        ------
        UsageError
            If xarray is not installed.
        """
        xarray = library("xarray")
        nodes = {}
        for item in self.result.rss:
            level = {"measured_db": item.measured_db, "calibrated_db": item.measured_db + item.score.offset_db}
            level |= {"simulated_dbm": item.simulated_dbm, "residual_db": item.score.residual_db}
            columns = {**level, **_place(item.position_m)}
            nodes[_node((item.tower, item.channel))] = xarray.Dataset(
                {name: ("time", values) for name, values in columns.items()}, {"time": item.time}, {"unit": item.unit}
            ).set_coords(["east_m", "north_m", "up_m"])
        for one_rank in self.result.rank:
            ranks = np.array(list(one_rank.rank.values()))
            nodes[_node((one_rank.tower, "rank"))] = xarray.Dataset(
                {"measured": ("time", one_rank.measured), "simulated": (("k", "time"), ranks)},
                {"time": one_rank.time, "k": list(one_rank.rank)},
            )
        return _tree(nodes)

    def plot(self, axes: Any = None) -> Any:
        """Draw calibrated and simulated levels over time on matplotlib axes, as :meth:`Flight.plot` does."""
        axes = axes if axes is not None else _new_axes()
        for item in self.result.rss:
            name, measured_dbm = f"{item.tower} {item.channel}", item.measured_db + item.score.offset_db
            (line,) = axes.plot(item.time, measured_dbm, ".", markersize=2, label=f"{name} measured")
            axes.plot(item.time, item.simulated_dbm, color=line.get_color(), label=f"{name} simulated")
        axes.set(xlabel="Time [UTC]", ylabel="Level [dBm]")
        axes.legend()
        return axes

    def __repr__(self) -> str:
        texts = [table.to_string(index=False) for table in self._tables()]
        return "\n\n".join(texts) or "Comparison: no series"

    def _repr_html_(self) -> str:
        return "".join(table.to_html(index=False, border=0) for table in self._tables())

    def _tables(self) -> list[pd.DataFrame]:
        return [table.round(2) for table in (self.to_frame(), self.rank_to_frame()) if len(table)]


def _node(series: Series) -> str:
    """Return the node of a series in a tree, whose names cannot contain a slash."""
    return "/".join(name.replace("/", "_") for name in series)


def _tree(nodes: Mapping[str, Any]) -> Any:
    return library("xarray").DataTree.from_dict(nodes)


def _new_axes() -> Any:
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def _utc(time: Any) -> pd.DatetimeIndex:
    instants: pd.DatetimeIndex = pd.DatetimeIndex(time).tz_localize("UTC")
    return instants


def _place(position_m: FloatArray) -> dict[str, FloatArray]:
    return {"east_m": position_m[:, 0], "north_m": position_m[:, 1], "up_m": position_m[:, 2]}


def _together(frames: Sequence[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    table: pd.DataFrame = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame(columns=list(columns))
    return table


__all__ = ["Comparison", "Flight", "ReplayedFlight", "open_flight"]
