"""Files of the channel along a route: NetCDF, arrays for Sionna, a DeepMIMO scenario, and a table for an emulator."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from ..common.cf import Dataset, GrowingNetcdf, file_attributes, flags, library
from ..common.content import KEY
from ..common.errors import UsageError
from ..common.stages import Stages
from ..common.text import guarded
from ..common.units import AnyArray, FloatArray
from ..common.versions import tool_version
from ..propagation.drivers import added_up
from ..propagation.geometry import Poses
from ..propagation.replay import PathTable, Replay, frequency_responses, impulse_responses

_LINK, _PORTS = ("time", "tower"), ("rx", "tx")
_PATH = ("path", *_LINK)
_SITE, _ARRAY = "site frame, azimuth from east, counter-clockwise", "array frame, from the boresight, counter-clockwise"
# Dimensions that grow while a file is written: ``time`` with each part, and ``path`` with the number of paths of a
# link.
_GROWS = ("time", "path")


@dataclass(frozen=True, slots=True, kw_only=True)
class Along:
    """The poses of the UAV at equal steps along a flight or route.

    Parameters
    ----------
    name : str
    poses : Poses
    time_s : (poses,)
        Time since ``start`` [s].
    start : datetime64, optional
        Start of the flight (UTC); None for a route that was not flown.
    number : (poses,), optional
        Number of each pose, if the route has no times.
    towers_m : (poses, 3), optional
        Positions of the tower, if it moves [m].
    velocity_mps, tower_mps : (poses, 3), optional
        Velocities of the UAV, and of the tower if it moves [m/s]. None if they cannot be computed from the times.
    remarks : tuple of str
    """

    name: str
    poses: Poses
    time_s: FloatArray
    start: Any = None
    number: FloatArray | None = None
    towers_m: FloatArray | None = None
    velocity_mps: FloatArray | None = None
    tower_mps: FloatArray | None = None
    remarks: tuple[str, ...] = ()

    def part(self, rows: slice) -> Along:
        """Return these poses."""
        arrays = {"time_s": self.time_s, "number": self.number, "towers_m": self.towers_m,
                  "velocity_mps": self.velocity_mps, "tower_mps": self.tower_mps}  # fmt: skip
        some: Any = {name: None if values is None else values[rows] for name, values in arrays.items()}
        return replace(self, poses=self.poses[rows], **some)


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """The channel of towers along a route.

    Parameters
    ----------
    along : Along
    link : str
        Name of the link in the flight file.
    replay : Replay
    table : PathTable
    summed : {"coherent", "power"}
        How the paths of a link are summed to its level.
    level_db, level_sd_db : (poses, towers), optional
        Calibrated level and its standard deviation, in the unit of the log.
    level_unit : str
    trained_on : tuple of str
        SHA-256 of the logs from which the level was learned.
    offsets_hz : (subcarriers,), optional
        Frequencies of the frequency response relative to the carrier [Hz].
    """

    along: Along
    link: str
    replay: Replay
    table: PathTable
    summed: Literal["coherent", "power"] = "power"
    level_db: FloatArray | None = None
    level_sd_db: FloatArray | None = None
    level_unit: str = ""
    trained_on: tuple[str, ...] = ()
    offsets_hz: FloatArray | None = None

    @property
    def carrier_hz(self) -> float:
        """The carrier of the link [Hz]."""
        return self.replay.ends.link.carrier_hz

    @property
    def doppler_hz(self) -> FloatArray | None:
        """The Doppler shift (paths,) [Hz]. None if the velocity is unknown."""
        own, other = self.along.velocity_mps, self.along.tower_mps
        return None if own is None else self.table.doppler_hz(self.carrier_hz, own, 0.0 if other is None else other)

    @property
    def warnings(self) -> list[str]:
        """Warnings about the limits of the numbers."""
        return [*self.along.remarks, *(f"Not modelled: {what}" for what in self.replay.left_out)]

    def by_link(self, values: AnyArray | None, fill: Any = np.nan) -> Any:
        """Return values per path (paths, ...) as an array (paths per link, poses, towers, ...). None stays None."""
        return None if values is None else self.table.by_link(values, self.replay.ends, fill)


def channel_dataset(channel: Channel) -> Dataset:
    """Return the channel as labelled variables: paths over (path, time, tower), H and levels over (time, tower)."""
    variables = {
        name: _variable(name, values, dimensions, *about)
        for name, values, dimensions, *about in _quantities(channel)
        if values is not None
    }
    link, along = channel.replay.ends.link, channel.along
    written = file_attributes(
        title=f"Channel along {along.name}, link {channel.link}",
        source="ray tracing along a flight",
        comment=" ".join(channel.warnings),
    )
    ends = {"transmitter": "UAV" if link.uav_transmits else "tower"}
    data = Dataset(variables, {**written, "link": channel.link, "carrier_hz": link.carrier_hz,
                               "transmit_power_dbm": link.transmit_power_dbm, **ends})  # fmt: skip
    described = {name: variable.attrs for name, variable in data.variables.items()}
    described["kind"] |= flags(("no_path", *channel.table.kinds), np.int8, -1)
    described["faces"] |= _face_flags(channel)
    if along.start is not None:
        start = str(along.start.astype("datetime64[s]")).replace("T", " ")
        described["time"] |= {"standard_name": "time", "long_name": "time of the pose"}
        described["time"]["units"] = f"seconds since {start} UTC"
    elif along.number is not None:
        described["time"] |= {"long_name": "number of the pose: the route has no times", "units": "1"}
    if channel.level_db is not None:
        described["level_db"]["comment"] = f"unit: {channel.level_unit}; paths and H do not include learned antennas"
        # only the levels depend on logs
        for name in ("level_db", "level_sd_db"):
            described[name][KEY] = " ".join(channel.trained_on)
    return data


def _face_flags(channel: Channel) -> dict[str, Any]:
    """Return the meanings of the codes of ``faces``."""
    return flags(("no_path", *(name or "line_of_sight" for name in channel.table.names)), np.int32, -1)


def _quantities(channel: Channel) -> Iterator[tuple[str, AnyArray | None, tuple[str, ...], str, str]]:
    """Yield name, values, dimensions, unit and meaning of each quantity of a file.

    Values are None for a quantity that the channel does not have.
    """
    table, replay, of, sd = channel.table, channel.replay, channel.by_link, channel.level_sd_db
    ends, ports, offsets, speed = replay.ends, (*_LINK, *_PORTS), channel.offsets_hz, channel.along.velocity_mps
    cfr = None if offsets is None else frequency_responses(table, ends, offsets)
    yield "gain", of(table.gain, 0.0), (*_PATH, *_PORTS), "1", _GAIN
    yield "kind", of(table.kind.astype(np.int8), -1), _PATH, "", "kind of the path"
    yield "faces", of(table.via.astype(np.int32), -1), _PATH, "", "faces that a path touches, from tower to UAV"
    yield "h", replay.h, ports, "1", "channel matrix: sum of the gains over the paths"
    yield "tower", np.array(replay.towers, dtype=object), ("tower",), "", "name of the tower"
    meanings = "number of the path, the shortest first", "port of the receiver", "port of the transmitter"
    for name, count, meaning in zip(("path", *_PORTS), (table.most, *replay.h.shape[2:]), meanings, strict=True):
        yield name, np.arange(count, dtype=np.int32), (name,), "1", meaning
    yield "delay_s", of(table.delay_s), _PATH, "s", "delay between the array centres"
    doppler = "Doppler shift, positive while the path gets shorter"
    yield "doppler_hz", of(channel.doppler_hz), _PATH, "Hz", doppler
    for name, values in table.angles_deg(ends).items():
        angle, end, *array, _ = name.split("_")
        meaning = f"{angle} towards the path at its {end}: {_ARRAY if array else _SITE}"
        yield name, of(values), _PATH, "degree", meaning
    yield "level_db", channel.level_db, _LINK, "1", "level that the receiver would log, with learned antennas"
    yield "level_sd_db", sd, _LINK, "1", "standard deviation of level_db [dB], larger far from the training samples"
    yield "cfr", cfr, (*ports, "subcarrier"), "1", "channel matrix at the subcarriers"
    yield "subcarrier_hz", offsets, ("subcarrier",), "Hz", "offset of a subcarrier from the carrier"
    yield "time", _times(channel.along), ("time",), "s", "seconds since the start of the route (date unknown)"
    sources, along = (ends.sources_m[:, 0], "time") if ends.moving else (ends.sources_m, "tower")
    for i, name in enumerate(("east", "north", "up")):
        yield f"{name}_m", ends.poses.position_m[:, i], ("time",), "m", f"{name} of the site origin, UAV"
        yield f"tower_{name}_m", sources[:, i], (along,), "m", f"{name} of the site origin, tower"
        velocity = None if speed is None else speed[:, i]
        yield f"velocity_{name}_mps", velocity, ("time",), "m s-1", f"velocity {name}, UAV"


_GAIN = "gain of a path at the carrier, including its phase; 0 without a path"


def _times(along: Along) -> FloatArray:
    """Return the time coordinate (poses,): seconds since a full second or since the start, or numbers of poses."""
    if along.start is None:
        return along.time_s if along.number is None else along.number
    fraction = (along.start - along.start.astype("datetime64[s]")) / np.timedelta64(1, "s")
    return np.asarray(along.time_s + fraction, dtype=np.float64)


def _variable(name: str, values: AnyArray, dimensions: tuple[str, ...], unit: str, meaning: str) -> tuple[Any, ...]:
    """Return dimensions, values, attributes and encoding of a variable."""
    about = {"long_name": meaning, **({"units": unit} if unit else {})}
    if np.iscomplexobj(values):
        # a higher compression level does not help: level 1 removes the zeros, and phases cannot be compressed
        return dimensions, values, about, {"complevel": 1, **({"_FillValue": 0.0} if name == "gain" else {})}
    missing: Any = {"i": values.dtype.type(-1), "f": np.nan}.get(values.dtype.kind)
    of_links = dimensions[: len(_PATH)] == _PATH or dimensions == _LINK
    return dimensions, values, about, {"_FillValue": missing} if of_links else {}


# --- files ---------------------------------------------------------------------------------------------------------


def write_channel(
    parts: Iterable[Channel], folder: Path, formats: Sequence[str], stages: Stages
) -> tuple[list[Path], dict[str, Any]]:
    """Write the consecutive parts of a channel.

    Parameters
    ----------
    parts : iterable of Channel
        Parts of the channel. There must be only one part if a format is not in :data:`STREAMED`.
    folder : Path
    formats : sequence of str
        Names of :data:`FORMATS`.
    stages : Stages
        Receives the time of the stage "write".

    Returns
    -------
    list of Path
        The main file of each format.
    dict
        Summary of the files, for ``--json``.
    """
    poses, paths, omitted = 0, 0, list[Any]()
    with ExitStack() as stack:
        writers = [_WRITERS.get(name) or stack.enter_context(_netcdf(folder)) for name in formats]
        for channel in parts:
            poses, paths = poses + len(channel.along.time_s), paths + len(channel.table.pose)
            omitted = added_up([*omitted, *channel.replay.omitted])
            latest = replace(channel, replay=replace(channel.replay, omitted=omitted))
            with stages("write"):
                files = [write(latest, folder) for write in writers]
    return files, {
        "flight": latest.along.name,
        "link": latest.link,
        "carrier_hz": latest.carrier_hz,
        "towers": list(latest.replay.towers),
        "poses": poses,
        "paths": paths,
        "has_doppler": latest.along.velocity_mps is not None,
        "has_level": latest.level_db is not None,
        KEY: list(latest.trained_on),
        "warnings": latest.warnings,
    }


@contextmanager
def _netcdf(folder: Path) -> Any:
    with GrowingNetcdf(folder / "channel.nc", _GROWS) as book:

        def write(channel: Channel, folder: Path) -> Path:
            data = channel_dataset(channel)
            book.append(data)
            # update the attributes, because later parts add remarks and faces
            book.describe(comment=data.attrs["comment"])
            book.describe("faces", **_face_flags(channel))
            return folder / "channel.nc"

        yield write


def _arrays(channel: Channel) -> dict[str, Any]:
    """Return gains and delays in the axis order of Sionna, with their towers and times."""
    a, tau = impulse_responses(channel.table, channel.replay.ends)
    arrays = {
        "a": a,
        "tau": tau,
        "h": channel.replay.h,
        "time_s": channel.along.time_s,
        "position_m": channel.replay.ends.poses.position_m,
        "towers": np.array(channel.replay.towers),
        "carrier_hz": channel.carrier_hz,
        "doppler_hz": channel.by_link(channel.doppler_hz),
        "level_db": channel.level_db,
        "level_sd_db": channel.level_sd_db,
    }
    return {name: values for name, values in arrays.items() if values is not None}


def _write_npz(channel: Channel, folder: Path) -> Path:
    np.savez(folder / "channel.npz", **_arrays(channel))
    return folder / "channel.npz"


def _write_csv(channel: Channel, folder: Path) -> Path:
    """Write one row per time and tower: level of the link, and delay and Doppler shift of its strongest path."""
    path, table, (poses, towers) = folder / "channel.csv", channel.table, channel.replay.has_path.shape
    power = channel.by_link((np.abs(table.gain) ** 2).mean(axis=(1, 2)), -1.0)
    strongest = power.argmax(axis=0) if table.most else np.zeros((poses, towers), dtype=np.int64)
    time: AnyArray = channel.along.time_s
    if channel.along.start is not None:
        instants = channel.along.start + np.round(channel.along.time_s * 1e9).astype("timedelta64[ns]")
        time = np.char.add(np.datetime_as_string(instants, unit="ms"), "Z")
    gain_db = channel.replay.level_dbm(channel.summed) - channel.replay.ends.link.transmit_power_dbm
    shown: dict[str, Any] = {"time": np.repeat(time, towers), "tower": np.tile(channel.replay.towers, poses)}
    shown["gain_db"] = gain_db.ravel().round(3)
    for name, values in (("delay_s", table.delay_s), ("doppler_hz", channel.doppler_hz)):
        each = channel.by_link(values) if table.most else None
        shown[name] = np.nan if each is None else np.take_along_axis(each, strongest[None], axis=0).ravel()
    # the first part creates the file, and later parts are appended
    guarded(pd.DataFrame(shown)).to_csv(path, mode="a", header=not path.exists(), index=False, float_format="%.9g")
    return path


def _write_deepmimo(channel: Channel, folder: Path) -> Path:
    """Write a DeepMIMO 4 scenario from towers to poses, from port 1 to port 1, with elevations from the zenith."""
    table, ends, link = channel.table, channel.replay.ends, channel.replay.ends.link
    scenario = folder / "deepmimo" / (re.sub(r"[^a-z0-9]+", "_", channel.along.name.lower()).strip("_") or "flight")
    scenario.mkdir(parents=True)
    gain = table.gain[:, 0, 0]
    angles = table.angles_deg(ends)
    leave, arrive = ("arrival", "departure") if link.uav_transmits else ("departure", "arrival")
    with np.errstate(divide="ignore"):
        columns = {"power": 20.0 * np.log10(np.abs(gain)), "phase": np.degrees(np.angle(gain)), "delay": table.delay_s}
    for name, end in (("aod", leave), ("aoa", arrive)):
        columns[f"{name}_az"] = angles[f"azimuth_{end}_deg"]
        columns[f"{name}_el"] = 90.0 - angles[f"elevation_{end}_deg"]
    columns |= {"inter": table.turns.astype(np.float64), "inter_pos": table.vertices_m}
    by_link = {name: channel.by_link(values).swapaxes(0, 1) for name, values in columns.items()}
    sources = np.nanmedian(ends.sources_m, axis=0) if ends.moving else ends.sources_m
    for number in range(len(channel.replay.towers)):
        arrays = {name: values[:, :, number] for name, values in by_link.items()}
        arrays |= {"rx_pos": ends.poses.position_m, "tx_pos": sources[number : number + 1]}
        for name, values in arrays.items():
            np.savez_compressed(scenario / f"{name}_t000_tx{number:03}_r001.npz", **{name: values})
    covered = int(channel.replay.has_path.any(axis=1).sum())
    about = _deepmimo_parameters(channel, {"tx": (len(sources), len(sources)), "rx": (len(ends.poses), covered)})
    for name, content in (("params", about), ("objects", [])):
        (scenario / f"{name}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    np.savez_compressed(scenario / "vertices.npz", vertices=np.zeros((0, 3)))
    return scenario / "params.json"


def _deepmimo_parameters(channel: Channel, points: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Return the entries of params.json that the loader of DeepMIMO requires."""
    sets = {
        f"txrx_set_{number}": {"name": name, "id": number, f"is_{name}": True, "num_points": every,
                               "num_active_points": active, f"is_{'rx' if name == 'tx' else 'tx'}": False}
        for number, (name, (every, active)) in enumerate(points.items())
    }  # fmt: skip
    rays = {"raytracer_name": "aerpaw-cmp", "raytracer_version": tool_version(), "frequency": channel.carrier_hz}
    rays |= {"max_reflections": channel.table.vertices_m.shape[1], "max_diffractions": 1}
    return {"version": "4.0", "rt_params": rays, "scene": {"num_scenes": 1}, "materials": {}, "txrx_sets": sets}


# Writers of a part by format, which return the main file.
_WRITERS = {"npz": _write_npz, "deepmimo": _write_deepmimo, "csv": _write_csv}
FORMATS = ("netcdf", *_WRITERS)
ALL = "all"

# Formats that are written part by part. All other formats need the complete channel in memory.
STREAMED = {"netcdf", "csv"}


def chosen_formats(names: Iterable[str]) -> tuple[str, ...]:
    """Return the formats that a user chose. Names may be joined by commas, and ``all`` means every format.

    Raises
    ------
    UsageError
        If a name is unknown, or netCDF4 is missing. Both errors are reported before a replay, which may take hours.

    Examples
    --------
    >>> chosen_formats(["csv,npz", "csv"])
    ('npz', 'csv')
    """
    chosen = {part.strip().lower() for name in names for part in name.split(",")} - {""}
    if unknown := sorted(chosen - {*FORMATS, ALL}):
        raise UsageError(f"format {unknown[0]!r}", expected=", ".join((*FORMATS, ALL)))
    formats = tuple(name for name in FORMATS if name in chosen or ALL in chosen)
    if "netcdf" in formats:
        library("netCDF4")
    return formats
