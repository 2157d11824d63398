"""Channel along a route as files: NetCDF, arrays for Sionna, a DeepMIMO scenario, MATLAB, a table for an emulator."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.cf import GrowingNetcdf, dataset, file_attributes
from ...common.counting import counted
from ...common.errors import UsageError
from ...common.provenance import KEY
from ...common.stages import Stages
from ...common.units import AnyArray, FloatArray
from ...common.versions import tool_version, utc_now
from ...propagation.drivers.parts import added_up
from ...propagation.path_table import KINDS, PathTable, frequency_responses, impulse_responses
from ...propagation.replay import Replay

# Gains and frequency responses that are held in memory at once.
MOST_BYTES = 2 << 30

_LINK, _PORTS = ("pose", "tower"), ("rx", "tx")
_PATH = ("path", *_LINK)
# Dimensions, unit and meaning of the variables of a file; *_real and *_imag of one name share a row.
_SITE, _ARRAY = "site frame, azimuth from east, counter-clockwise", "array frame, from the boresight, counter-clockwise"
_ABOUT: dict[str, tuple[tuple[str, ...], str, str]] = {
    "gain": ((*_PATH, *_PORTS), "1", "gain of a path at the carrier, its phase included; 0 without a path"),
    "h": ((*_LINK, *_PORTS), "1", "channel matrix: sum of the gains over the paths"),
    "cfr": ((*_LINK, *_PORTS, "subcarrier"), "1", "channel matrix at the subcarriers"),
    "subcarrier_hz": (("subcarrier",), "Hz", "offset of a subcarrier from the carrier"),
    "delay_s": (_PATH, "s", "delay between the array centres"),
    "doppler_hz": (_PATH, "Hz", "Doppler shift, positive while the path gets shorter"),
    "kind": (_PATH, "", "kind of the path"),
    "faces": (_PATH, "", "row of face_names"),
    "face_names": (("faces_of_a_path",), "", "faces that a path touches, from tower to UAV"),
    **{
        f"{angle}_{end}{frame}_deg": (_PATH, "degree", f"{angle} towards the path at its {end}: {text}")
        for angle in ("azimuth", "elevation")
        for end in ("departure", "arrival")
        for frame, text in (("", _SITE), ("_array", _ARRAY))
    },
    "level_db": (_LINK, "1", "level that the receiver would log, of antennas that flights taught"),
    "level_sd_db": (_LINK, "1", "standard deviation of level_db [dB]"),
    "tower_name": (("tower",), "", "name of the tower"),
    "time": (("pose",), "s", "since the start of the route"),
    **{
        f"{end}{name}_m": ((dimension,), "m", f"{name} of the site origin, {text}")
        for end, dimension, text in (("", "pose", "UAV"), ("tower_", "tower", "tower"))
        for name in ("east", "north", "up")
    },
    **{f"velocity_{name}_mps": (("pose",), "m s-1", f"velocity {name}, UAV") for name in ("east", "north", "up")},
}
# Dimensions along which the file grows, pose by pose or with the link that has most paths.
_GROWS = ("pose", "path", "faces_of_a_path", "face_names_length")


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """Channel of towers along a route.

    Parameters
    ----------
    name : str
    link : str
        Which link of the flight file.
    replay : Replay
    table : PathTable
    time_s : (poses,)
        Since ``start``.
    start : datetime64, optional
        UTC; None of a route that was not flown.
    velocity_mps : (poses, 3), optional
    tower_mps : (poses, 3), optional
        Of a tower that moves.
    summed : {"coherent", "power"}
        How the level of a link adds up its paths.
    level_db, level_sd_db : (poses, towers), optional
        Calibrated level and its standard deviation, in the unit of the log.
    level_unit : str
    trained_on : tuple of str
        SHA-256 of the logs that taught the level.
    guesses : int
        Levels where no flight taught the antennas.
    offsets_hz : (subcarriers,), optional
        Of the frequency response.
    remarks : tuple of str
    """

    name: str
    link: str
    replay: Replay
    table: PathTable
    time_s: FloatArray
    start: Any = None
    velocity_mps: FloatArray | None = None
    tower_mps: FloatArray | float = 0.0
    summed: str = "power"
    level_db: FloatArray | None = None
    level_sd_db: FloatArray | None = None
    level_unit: str = ""
    trained_on: tuple[str, ...] = ()
    guesses: int = 0
    offsets_hz: FloatArray | None = None
    remarks: tuple[str, ...] = ()

    @property
    def carrier_hz(self) -> float:
        """Carrier of the link."""
        return self.replay.ends.link.carrier_hz

    @property
    def doppler_hz(self) -> FloatArray | None:
        """Doppler shift (paths,); None without a velocity."""
        if self.velocity_mps is None:
            return None
        return self.table.doppler_hz(self.carrier_hz, self.velocity_mps, self.tower_mps)

    @property
    def gain_db(self) -> FloatArray:
        """Received over sent power (poses, towers) [dB]; NaN without a path."""
        level = self.replay.rss_power_dbm if self.summed == "power" else self.replay.rss_dbm
        return np.asarray(level - self.replay.ends.link.transmit_power_dbm)

    @property
    def warnings(self) -> list[str]:
        """Sentences on what the numbers lack."""
        words = (
            f"Where no flight taught the antennas: {counted(self.guesses, 'level')}, of a larger standard deviation."
        )
        return [*self.remarks, *([words] if self.guesses else []), *self.replay.left_out]

    def by_link(self, values: AnyArray | None, fill: Any = np.nan) -> Any:
        """Values per path (paths, ...) as (most paths of a link, poses, towers, ...); None of None."""
        if values is None:
            return None
        table = self.table
        out = np.full((table.most, *self.replay.has_path.shape, *values.shape[1:]), fill, values.dtype)
        out[table.number, table.pose, table.tower] = values
        return out


def refuse_size(size: int, what: str, most: int = MOST_BYTES) -> None:
    """UsageError for more bytes of gains than there is room for: in memory, else on the disk."""
    if size > most:
        further = ", or netcdf and csv alone" if most == MOST_BYTES else " of disk"
        raise UsageError(
            f"{size / 2**30:.0f} GiB of gains: {what}",
            expected=f"at most {most / 2**30:.0f} GiB{further}",
            cause="too short a --step, or too many --subcarriers",
        )


def channel_dataset(channel: Channel) -> Any:
    """The channel as an ``xarray.Dataset``: paths by (path, pose, tower), H and levels by (pose, tower).

    Raises
    ------
    UsageError
        xarray is not installed; more numbers than fit in memory.
    """
    table, replay, offsets = channel.table, channel.replay, channel.offsets_hz
    poses, towers = replay.has_path.shape
    size = 16 * replay.h.size * (table.most + (0 if offsets is None else len(offsets)))
    refuse_size(size, f"{poses} poses, {towers} towers, {table.most} paths")
    values: dict[str, AnyArray | None] = {
        "gain": channel.by_link(table.gain, 0.0),
        "kind": channel.by_link(table.kind.astype(np.int8), -1),
        "faces": channel.by_link(table.via.astype(np.int32), -1),
        "face_names": np.array(table.names, dtype=object),
        "h": replay.h,
        "tower_name": np.array(replay.towers, dtype=object),
        "delay_s": channel.by_link(table.delay_s),
        "doppler_hz": channel.by_link(channel.doppler_hz),
        **{name: channel.by_link(angle) for name, angle in table.angles_deg(replay.ends).items()},
        "level_db": channel.level_db,
        "level_sd_db": channel.level_sd_db,
        "cfr": None if offsets is None else frequency_responses(table, replay.ends, offsets),
        "subcarrier_hz": offsets,
        "time": channel.time_s,
        **_places(channel),
    }
    variables: dict[str, Any] = {}
    for name, array in values.items():
        if array is not None:
            variables |= _variables(name, array, replay.ends.moving)
    data = dataset(variables, _file(channel))
    data.kind.attrs |= {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
    if channel.start is not None:
        start = str(channel.start).replace("T", " ")
        data.time.attrs |= {"long_name": f"since {start} UTC", "units": f"seconds since {start[:19]} UTC"}
    if channel.level_db is not None:
        data.level_db.attrs["comment"] = f"unit: {channel.level_unit}"
    return data


def _variables(name: str, values: AnyArray, moving: bool) -> dict[str, Any]:
    """A variable as ``xarray`` takes it, by name; two of complex numbers."""
    dimensions, unit, meaning = _ABOUT[name]
    if moving and dimensions == ("tower",) and unit:
        dimensions = ("pose",)  # its place
    about = {"long_name": meaning, **({"units": unit} if unit else {})}
    if np.iscomplexobj(values):
        # digits of a phase do not deflate: level 1 takes out the zeros alone
        encoding = {"complevel": 1, **({"_FillValue": 0.0} if name == "gain" else {})}
        halves = (("real", values.real), ("imag", values.imag))
        return {
            f"{name}_{part}": (dimensions, half, about | {"long_name": f"{meaning} ({part})"}, encoding)
            for part, half in halves
        }
    missing: Any = {"i": values.dtype.type(-1), "f": np.nan}.get(values.dtype.kind)
    of_links = dimensions[: len(_PATH)] == _PATH or dimensions == _LINK
    return {name: (dimensions, values, about, {"_FillValue": missing} if of_links else {})}


def _places(channel: Channel) -> dict[str, AnyArray | None]:
    """Places of both ends, velocity."""
    ends, velocity = channel.replay.ends, channel.velocity_mps
    sources = ends.sources_m[:, 0] if ends.moving else ends.sources_m
    out: dict[str, AnyArray | None] = {}
    for i, name in enumerate(("east", "north", "up")):
        out[f"{name}_m"], out[f"tower_{name}_m"] = ends.poses.position_m[:, i], sources[:, i]
        out[f"velocity_{name}_mps"] = None if velocity is None else velocity[:, i]
    return out


def _file(channel: Channel) -> dict[str, Any]:
    about = file_attributes(
        title=f"Channel along {channel.name}, link {channel.link}",
        source="ray tracing along a flight",
        generated=utc_now(),
        version=tool_version(),
        comment=" ".join(channel.warnings),
    )
    link = channel.replay.ends.link
    return {
        **about,
        "carrier_hz": link.carrier_hz,
        "transmit_power_dbm": link.transmit_power_dbm,
        "transmitter": "UAV" if link.uav_transmits else "tower",
        "trained_on": " ".join(channel.trained_on),
    }


# --- files ---------------------------------------------------------------------------------------------------------


def write_channel(
    parts: Iterable[Channel], folder: Path, formats: Sequence[str], stages: Stages
) -> tuple[list[Path], dict[str, Any]]:
    """Write parts of a channel that follow each other, each as it comes.

    Parameters
    ----------
    parts : iterable of Channel
        One alone where a format is not of :data:`STREAMED`.
    folder : Path
    formats : sequence of str
        Of :data:`FORMATS`.
    stages : Stages
        Times "write".

    Returns
    -------
    list of Path
        The file to open of each format.
    dict
        What was written, for ``--json``.
    """
    poses, paths, guesses = 0, 0, 0
    omitted: list[Any] = []
    with ExitStack() as stack:
        writers = [stack.enter_context(FORMATS[name](folder)) for name in formats]
        for channel in parts:
            poses, paths = poses + len(channel.time_s), paths + len(channel.table.pose)
            guesses, omitted = guesses + channel.guesses, added_up([*omitted, *channel.replay.omitted])
            latest = replace(channel, guesses=guesses, replay=replace(channel.replay, omitted=omitted))
            with stages("write"):
                files = [write(latest) for write in writers]
    return files, {
        "flight": latest.name,
        "link": latest.link,
        "carrier_hz": latest.carrier_hz,
        "towers": list(latest.replay.towers),
        "poses": poses,
        "paths": paths,
        "has_doppler": latest.velocity_mps is not None,
        "has_level": latest.level_db is not None,
        KEY: list(latest.trained_on),
        "warnings": latest.warnings,
    }


@contextmanager
def _netcdf(folder: Path) -> Any:
    path = folder / "channel.nc"
    with GrowingNetcdf(path, _GROWS) as book:

        def write(channel: Channel) -> Path:
            data = channel_dataset(channel)
            book.append(data)
            book.describe(comment=data.attrs["comment"])
            return path

        yield write


def _arrays(channel: Channel) -> dict[str, Any]:
    """Gains and delays in Sionna's axis order, and what they belong to."""
    a, tau = impulse_responses(channel.table, channel.replay.ends)
    arrays = {
        "a": a,
        "tau": tau,
        "h": channel.replay.h,
        "time_s": channel.time_s,
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


def _write_mat(channel: Channel, folder: Path) -> Path:
    from scipy.io import savemat

    savemat(folder / "channel.mat", _arrays(channel), do_compression=True, oned_as="column")
    return folder / "channel.mat"


def _write_csv(channel: Channel, folder: Path) -> Path:
    """A row per instant and tower: the level of the link, delay and Doppler shift of its strongest path."""
    path = folder / "channel.csv"
    poses, towers = channel.gain_db.shape
    power = channel.by_link((np.abs(channel.table.gain) ** 2).mean(axis=(1, 2)), 0.0)
    columns = {"delay_s": channel.table.delay_s, "doppler_hz": channel.doppler_hz}
    time: AnyArray = channel.time_s
    if channel.start is not None:
        instants = channel.start + np.round(channel.time_s * 1e9).astype("timedelta64[ns]")
        time = np.char.add(np.datetime_as_string(instants, unit="ms"), "Z")
    shown = {"time": np.repeat(time, towers), "tower": np.tile(channel.replay.towers, poses)}
    shown["gain_db"] = channel.gain_db.ravel().round(3)
    for name, values in columns.items():
        at = channel.gain_db * np.nan
        if values is not None and len(power):
            at = np.take_along_axis(channel.by_link(values), power.argmax(axis=0)[None], axis=0)[0]
        shown[name] = at.ravel()
    pd.DataFrame(shown).to_csv(path, mode="a", header=not path.exists(), index=False, float_format="%.9g")
    return path


def _write_deepmimo(channel: Channel, folder: Path) -> Path:
    """A scenario of DeepMIMO 4: towers transmit to the poses, first port to first port, elevations from the zenith."""
    table, ends, link = channel.table, channel.replay.ends, channel.replay.ends.link
    scenario = folder / "deepmimo" / (re.sub(r"[^a-z0-9]+", "_", channel.name.lower()).strip("_") or "flight")
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
    (scenario / "params.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
    (scenario / "objects.json").write_text("[]", encoding="utf-8")
    np.savez_compressed(scenario / "vertices.npz", vertices=np.zeros((0, 3)))
    return scenario / "params.json"


def _deepmimo_parameters(channel: Channel, points: Mapping[str, tuple[int, int]]) -> dict[str, Any]:
    """Content of params.json that the loader asks for; all else of its device sets has its defaults."""
    sets = {
        f"txrx_set_{number}": {"name": name, "id": number, f"is_{name}": True, "num_points": every,
                               "num_active_points": active, f"is_{'rx' if name == 'tx' else 'tx'}": False}
        for number, (name, (every, active)) in enumerate(points.items())
    }  # fmt: skip
    rays = {"raytracer_name": "aerpaw-cmp", "raytracer_version": tool_version(), "frequency": channel.carrier_hz}
    rays |= {"max_reflections": channel.table.vertices_m.shape[1], "max_diffractions": 1}
    return {"version": "4.0", "rt_params": rays, "scene": {"num_scenes": 1}, "materials": {}, "txrx_sets": sets}


def _each(write: Callable[[Channel, Path], Path]) -> Callable[[Path], Any]:
    return lambda folder: nullcontext(lambda channel: write(channel, folder))


# Writers by the name of their format, as a context of a folder; each gives the file to open.
FORMATS: dict[str, Callable[[Path], AbstractContextManager[Callable[[Channel], Path]]]] = {
    "netcdf": _netcdf,
    "npz": _each(_write_npz),
    "deepmimo": _each(_write_deepmimo),
    "mat": _each(_write_mat),
    "csv": _each(_write_csv),
}

# Those that take a channel part by part; the others are held in memory.
STREAMED = {"netcdf", "csv"}
