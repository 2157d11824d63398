"""Channel along a route as files: NetCDF, arrays for Sionna, a DeepMIMO scenario, MATLAB, a table for an emulator."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ...common.cf import dataset, file_attributes, netcdf_bytes
from ...common.errors import UsageError
from ...common.units import AnyArray, FloatArray
from ...common.versions import tool_version, utc_now
from ...propagation.path_table import KINDS, PathTable, frequency_responses, impulse_responses
from ...propagation.replay import Replay

_PORTS = ("rx", "tx")
_LINK = ("pose", "tower")

# Gains and frequency responses that a file is made of in memory.
_MOST_BYTES = 2 << 30


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

    def by_link(self, values: AnyArray, fill: Any) -> AnyArray:
        """Values per path (paths, ...) as (most paths of a link, poses, towers, ...)."""
        table = self.table
        out = np.full((table.most, *self.gain_db.shape, *values.shape[1:]), fill, values.dtype)
        out[table.number, table.pose, table.tower] = values
        return out


def channel_dataset(channel: Channel) -> Any:
    """The channel as an ``xarray.Dataset``: paths by (path, pose, tower), H and levels by (pose, tower).

    Raises
    ------
    UsageError
        xarray is not installed; more numbers than fit in memory.
    """
    table, replay = channel.table, channel.replay
    subcarriers = 0 if channel.offsets_hz is None else len(channel.offsets_hz)
    size = 16 * replay.h.size * (table.most + subcarriers)
    if size > _MOST_BYTES:
        raise UsageError(
            f"{size / 2**30:.0f} GiB of gains: {len(replay.h)} poses, {len(replay.towers)} towers, {table.most} paths, "
            f"{subcarriers} subcarriers",
            expected=f"at most {_MOST_BYTES >> 30} GiB",
            cause="too short a --step, or too many --subcarriers",
        )
    paths, faces = ("path", *_LINK), np.array(table.names, dtype=object)
    gain = channel.by_link(table.gain, 0.0)
    flags = {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
    none = {"_FillValue": np.int8(-1)}
    variables: dict[str, Any] = {
        **_parts(
            "gain", (*paths, *_PORTS), gain, "gain of a path at the carrier, its phase included; 0 without a path"
        ),
        "delay_s": (paths, channel.by_link(table.delay_s, np.nan), _about("s", "delay between the array centres")),
        "kind": (paths, channel.by_link(table.kind.astype(np.int8), -1), _about("", "kind of the path") | flags, none),
        "faces": (paths, channel.by_link(table.via.astype(np.int32), -1), _about("", "row of face_names")),
        "face_names": ("faces_of_a_path", faces, _about("", "faces that a path touches, from tower to UAV")),
        **_parts("h", (*_LINK, *_PORTS), replay.h, "channel matrix: sum of the gains over the paths"),
        "tower_name": ("tower", np.array(replay.towers, dtype=object), _about("", "name of the tower")),
    }
    for name, values in table.angles_deg(replay.ends).items():
        frame = "array frame, from the boresight" if "_array" in name else "site frame, azimuth from east"
        text = f"{name.split('_')[0]} towards the path at its {name.split('_')[1]}: {frame}, counter-clockwise"
        variables[name] = paths, channel.by_link(values, np.nan), _about("degree", text)
    doppler = channel.doppler_hz
    if doppler is not None:
        text = "Doppler shift, positive while the path gets shorter"
        variables["doppler_hz"] = paths, channel.by_link(doppler, np.nan), _about("Hz", text)
    if channel.level_db is not None:
        unit = {"comment": f"unit: {channel.level_unit}"}
        text = "level that the receiver would log, of antennas that flights taught"
        variables["level_db"] = _LINK, channel.level_db, _about("1", text) | unit
        variables["level_sd_db"] = _LINK, channel.level_sd_db, _about("1", "standard deviation of level_db [dB]")
    if channel.offsets_hz is not None:
        cfr = frequency_responses(table, replay.ends, channel.offsets_hz)
        variables |= _parts("cfr", (*_LINK, *_PORTS, "subcarrier"), cfr, "channel matrix at the subcarriers")
        about = _about("Hz", "offset of a subcarrier from the carrier")
        variables["subcarrier_hz"] = "subcarrier", channel.offsets_hz, about
    return dataset(variables | _places(channel), _file(channel))


def _about(units: str, meaning: str) -> dict[str, Any]:
    return {"long_name": meaning, **({"units": units} if units else {})}


def _parts(name: str, dimensions: tuple[str, ...], values: AnyArray, meaning: str) -> dict[str, Any]:
    # digits of a phase do not deflate: level 1 takes out the zeros alone
    return {
        f"{name}_{part}": (dimensions, np.ascontiguousarray(half), _about("1", f"{meaning} ({part})"), {"complevel": 1})
        for part, half in (("real", values.real), ("imag", values.imag))
    }


def _places(channel: Channel) -> dict[str, Any]:
    """Time, places, velocity."""
    start, ends = channel.start, channel.replay.ends
    since = "the start of the route" if start is None else f"{str(start).replace('T', ' ')} UTC"
    time = _about("s" if start is None else f"seconds since {str(start)[:19].replace('T', ' ')} UTC", f"since {since}")
    out: dict[str, Any] = {"time": ("pose", channel.time_s, time)}
    for i, name in enumerate(("east", "north", "up")):
        out[f"{name}_m"] = "pose", ends.poses.position_m[:, i], _about("m", f"{name} of the site origin, UAV")
        sources = ends.sources_m if not ends.moving else ends.sources_m[:, 0]
        dimension = "pose" if ends.moving else "tower"
        out[f"tower_{name}_m"] = dimension, sources[:, i], _about("m", f"{name} of the site origin, tower")
        if channel.velocity_mps is not None:
            out[f"velocity_{name}_mps"] = "pose", channel.velocity_mps[:, i], _about("m s-1", f"velocity {name}, UAV")
    return out


def _file(channel: Channel) -> dict[str, Any]:
    about = file_attributes(
        title=f"Channel along {channel.name}, link {channel.link}",
        source="ray tracing along a flight",
        generated=utc_now(),
        version=tool_version(),
        comment=" ".join(channel.remarks),
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


def _write_netcdf(channel: Channel, folder: Path) -> Path:
    (folder / "channel.nc").write_bytes(netcdf_bytes(channel_dataset(channel)))
    return folder / "channel.nc"


def _arrays(channel: Channel) -> dict[str, Any]:
    """Gains and delays in Sionna's axis order, and what they belong to."""
    a, tau = impulse_responses(channel.table, channel.replay.ends)
    doppler = channel.doppler_hz
    moving = {} if doppler is None else {"doppler_hz": channel.by_link(doppler, np.nan)}
    levels = {} if channel.level_db is None else {"level_db": channel.level_db, "level_sd_db": channel.level_sd_db}
    return {
        "a": a,
        "tau": tau,
        "h": channel.replay.h,
        "time_s": channel.time_s,
        "position_m": channel.replay.ends.poses.position_m,
        "towers": np.array(channel.replay.towers),
        "carrier_hz": channel.carrier_hz,
        **moving,
        **levels,
    }


def _write_npz(channel: Channel, folder: Path) -> Path:
    np.savez(folder / "channel.npz", **_arrays(channel))
    return folder / "channel.npz"


def _write_mat(channel: Channel, folder: Path) -> Path:
    from scipy.io import savemat

    savemat(folder / "channel.mat", _arrays(channel), do_compression=True, oned_as="column")
    return folder / "channel.mat"


def _write_csv(channel: Channel, folder: Path) -> Path:
    """A row per instant and tower: the level of the link, delay and Doppler shift of its strongest path."""
    poses, towers = channel.gain_db.shape
    power = channel.by_link((np.abs(channel.table.gain) ** 2).mean(axis=(1, 2)), 0.0)
    strongest = power.argmax(axis=0)[None] if len(power) else np.zeros((1, poses, towers), dtype=np.int64)
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
            at = np.take_along_axis(channel.by_link(values, np.nan), strongest, axis=0)[0]
        shown[name] = at.ravel()
    pd.DataFrame(shown).to_csv(folder / "channel.csv", index=False, float_format="%.9g")
    return folder / "channel.csv"


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
    by_link = {name: channel.by_link(values, np.nan).swapaxes(0, 1) for name, values in columns.items()}
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


# Writers by the name of their format; each gives the file to open.
FORMATS: dict[str, Callable[[Channel, Path], Path]] = {
    "netcdf": _write_netcdf,
    "npz": _write_npz,
    "deepmimo": _write_deepmimo,
    "mat": _write_mat,
    "csv": _write_csv,
}
