"""Faults that no candidate cause contains, for :mod:`injected_causes`: what else goes wrong with radios and logs.

They were written without knowledge of how a cause is chosen. Each changes the columns of one flight by one of up to
three sizes. The names that describe a fault fairly were written down before the first run. Any other name is wrong, and
silence is right. Three consecutive seeds give each flight every size of a kind.
"""

# ruff: noqa: ARG001  a fault takes a table, a size and a generator, and some need fewer

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from planted_causes import TOWER

from aerpaw_cmp.site.siteyaml import load_site

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Table = dict[str, Array]
Draw = np.random.Generator
LEVELS = ("mpower1", "mpower2", "RSRP")
# Metres per degree of longitude and latitude at Lake Wheeler.
EAST_M, NORTH_M = 90_400.0, 111_000.0


@dataclass(frozen=True)
class Outside:
    """A fault outside the list: its change of a table, its sizes with their unit, and the names that fit it."""

    change: Callable[[Table, float, Draw], None]
    sizes: tuple[float, ...]
    unit: str
    allowed: tuple[str, ...] = ()

    def inject(self, table: Table, kind: str, flight: str, seed: int) -> str:
        """Change a table by one size and return that size. Each kind and flight has a separate stream of draws."""
        name = f"{kind}/{flight}".encode()
        size = self.sizes[(zlib.crc32(name) + seed) % len(self.sizes)]
        marks = {}
        for column in levels(table):  # a receiver writes -inf or NaN where it has no level
            known = np.isfinite(table[column])
            marks[column] = np.nan if known.all() else table[column][~known][0]
            table[column] = np.where(known, table[column], np.nan)
        self.change(table, size, np.random.default_rng([seed, *name]))
        for column, mark in marks.items():
            table[column] = np.where(np.isnan(table[column]), mark, table[column])
        return f"{size:g} {self.unit}"


def seconds(t: Table) -> Array:
    """Return the time since the first row [s]."""
    time = t["timestamp_power" if "timestamp_power" in t else "timestamp_meas"].astype(np.float64)
    return np.asarray(time - time[0])


def levels(t: Table) -> list[str]:
    """Return the names of the level columns."""
    return [name for name in LEVELS if name in t]


def add(t: Table, change_db: Array, names: list[str] | None = None) -> None:
    """Add a change [dB] to all or some level columns."""
    for name in levels(t) if names is None else names:
        t[name] = t[name] + change_db


def add_power(t: Table, other_db: Callable[[Array], Array], names: list[str] | None = None) -> None:
    """Add the power of a second source, whose level [dB] follows from the column's own, to level columns."""
    for name in levels(t) if names is None else names:
        level = t[name].astype(np.float64)
        t[name] = 10.0 * np.log10(10.0 ** (level / 10.0) + 10.0 ** (other_db(level) / 10.0))


def take(t: Table, rows: NDArray[np.int_], names: list[str] | None = None) -> None:
    """Give each row the level of another row."""
    for name in levels(t) if names is None else names:
        t[name] = t[name][rows]


def now_and_then(time: Array, draw: Draw, rest_s: float, active_s: float) -> Flags:
    """Return flags that are on for exponentially distributed times, after exponentially distributed rests."""
    count = 20 + int(3.0 * time[-1] / (rest_s + active_s))
    edges = np.cumsum(draw.exponential(np.tile([rest_s, active_s], count)))
    return np.asarray(np.searchsorted(edges, time) % 2 == 1)


def offset_m(t: Table, place_m: tuple[float, float] | Array = (0.0, 0.0)) -> Array:
    """Return east, north and up (n, 3) [m] from the tower, or from positions at an offset [m] from it, to the UAV."""
    tower = load_site("lake_wheeler").towers[TOWER]
    east, north = np.asarray(place_m).T
    return np.column_stack([
        (t["mX"] - tower.longitude_deg) * EAST_M - east,
        (t["mY"] - tower.latitude_deg) * NORTH_M - north,
        t["mZ"] - tower.antenna_height_m,
    ])  # fmt: skip


def distance_db(ray_m: Array) -> Array:
    """Return the free-space level along rays (n, 3), without a constant [dB]."""
    return np.asarray(-20.0 * np.log10(np.linalg.norm(ray_m, axis=1)))


def wandering(time: Array, draw: Draw, memory_s: float) -> Array:
    """Return a random signal of unit standard deviation and a correlation time."""
    knots = np.arange(0.0, time[-1] + 3.0, 2.0)
    keep, value = np.exp(-2.0 / memory_s), draw.normal(size=len(knots))
    for i in range(1, len(knots)):
        value[i] = keep * value[i - 1] + np.sqrt(1.0 - keep**2) * value[i]
    return np.interp(time, knots, value)


def ratchet(t: Table, size: float, draw: Draw) -> None:
    """The gain control takes one third of its range at each of three strong approaches and never gives it back."""
    time, level = seconds(t), t[levels(t)[0]]
    strong = np.flatnonzero(level > np.nanquantile(level, 0.8))
    starts = strong[np.diff(time[strong], prepend=-1e3) > 15.0][:3]
    add(t, -size / 3.0 * np.searchsorted(starts, np.arange(len(time)), side="right"))


def contact(t: Table, size: float, draw: Draw) -> None:
    """A connector of one channel loses contact for some seconds, again and again."""
    add(t, -size * now_and_then(seconds(t), draw, 30.0, 6.0), [str(draw.choice(levels(t)))])


def interference(t: Table, size: float, draw: Draw) -> None:
    """A neighbour's bursts add power on one channel, relative to its median level."""
    on = now_and_then(seconds(t), draw, 20.0, 8.0)
    add_power(t, lambda x: np.where(on, np.nanmedian(x) + size, -400.0), [str(draw.choice(levels(t)))])


def second_transmitter(t: Table, size: float, draw: Draw) -> None:
    """Another transmitter on the same carrier, 200 to 500 m from the tower, is stronger by a size at equal distance."""
    angle, radius = draw.uniform(0.0, 2.0 * np.pi), draw.uniform(200.0, 500.0)
    own = distance_db(offset_m(t))
    other = distance_db(offset_m(t, (radius * np.sin(angle), radius * np.cos(angle)))) + size
    add_power(t, lambda x: np.nanmedian(x - own) + other)


def ice(t: Table, size: float, draw: Draw) -> None:
    """Ice grows on the antenna in the middle of the flight, and stays."""
    time = seconds(t)
    share = np.clip((time / time[-1] - draw.uniform(0.1, 0.3)) / 0.5, 0.0, 1.0)
    add(t, -size * share**2 * (3.0 - 2.0 * share))


def mast_sways(t: Table, size: float, draw: Draw) -> None:
    """The mast sways in the wind, so that the level swings within seconds."""
    time = seconds(t)
    add(t, size * (0.5 + 0.5 * wandering(time, draw, 60.0)) * np.sin(2.0 * np.pi * draw.uniform(0.1, 0.3) * time))


def compression(t: Table, size: float, draw: Draw) -> None:
    """An amplifier compresses: above a quantile of the level each decibel adds only a part of one."""
    for name in levels(t):
        above = np.maximum(t[name] - np.nanquantile(t[name], 0.4), 0.0)
        t[name] = t[name] - (1.0 - size) * above


def warming(t: Table, size: float, draw: Draw) -> None:
    """The gain falls while the receiver warms up, at first quickly."""
    add(t, size * np.exp(-seconds(t) / draw.uniform(100.0, 250.0)))


def rounded_stamps(t: Table, size: float, draw: Draw) -> None:
    """Time stamps of the levels are cut to full periods: all rows of a period get the level of its first row."""
    period = np.floor((seconds(t) + draw.uniform(0.0, size)) / size)
    take(t, np.searchsorted(period, period))


def power_schedule(t: Table, size: float, draw: Draw) -> None:
    """The transmitter steps through three powers, each for half a minute."""
    add(t, -size * (np.floor((seconds(t) + draw.uniform(0.0, 90.0)) / 30.0) % 3))


def duty_cycle(t: Table, size: float, draw: Draw) -> None:
    """The transmitter is off for a share of each period of 12 s, and the receiver logs noise."""
    off = (seconds(t) + draw.uniform(0.0, 12.0)) % 12.0 < 12.0 * size
    for name in levels(t):
        noise = np.nanquantile(t[name], 0.02) - 6.0 + draw.normal(0.0, 1.5, len(off))
        t[name] = np.where(off, noise, t[name])


def repeated_rows(t: Table, size: float, draw: Draw) -> None:
    """A gap in the log is filled with the levels of the rows before it."""
    time = seconds(t)
    begin = draw.uniform(0.5, 0.75) * time[-1]
    length = min(size, 0.25 * time[-1])
    inside = (time >= begin) & (time < begin + length)
    take(t, np.where(inside, np.searchsorted(time, time - length), np.arange(len(time))))


def trailing_mean(t: Table, size: float, draw: Draw) -> None:
    """The receiver logs the mean level of the last seconds."""
    time = seconds(t)
    first, last = np.searchsorted(time, time - size), np.arange(1, len(time) + 1)
    for name in levels(t):
        total = np.concatenate(([0.0], np.nancumsum(t[name])))
        count = np.concatenate(([0], np.cumsum(np.isfinite(t[name]))))
        t[name] = (total[last] - total[first]) / np.maximum(count[last] - count[first], 1)


def peak_hold(t: Table, size: float, draw: Draw) -> None:
    """An analyser holds the largest level and is reset periodically."""
    part = np.floor((seconds(t) + draw.uniform(0.0, size)) / size)
    for name in levels(t):
        starts = np.flatnonzero(np.diff(part, prepend=-1.0))
        t[name] = np.concatenate([np.fmax.accumulate(piece) for piece in np.split(t[name], starts[1:])])


def mixed_units(t: Table, size: float, draw: Draw) -> None:
    """A share of the rows comes from a second program that writes dBm + 30."""
    add(t, 30.0 * now_and_then(seconds(t), draw, 40.0 * (1.0 - size), 40.0 * size))


def bank(t: Table, size: float, draw: Draw) -> None:
    """The polarisation turns away as the UAV banks, with a loss of the size at a roll of 10 degrees."""
    if "mRoll" in t:
        add(t, -size * (t["mRoll"] / 10.0) ** 2)


def body_sector(t: Table, size: float, draw: Draw) -> None:
    """The battery blocks the antenna in one sector of the body, by 12 dB with soft edges."""
    east, north, _ = -offset_m(t).T
    inside = np.arctan2(east, north) - np.radians(t.get("mYaw", 0.0 * east))
    off = np.degrees(np.abs(np.angle(np.exp(1j * (inside - draw.choice(inside))))))
    add(t, -12.0 / (1.0 + np.exp((off - size / 2.0) / 3.0)))


def another_day(t: Table, size: float, draw: Draw) -> None:
    """The levels are those of another flight, around a circle at another speed, under the name of this one."""
    time, ray = seconds(t), offset_m(t)
    angle = 2.0 * np.pi * time / draw.uniform(150.0, 400.0) + draw.uniform(0.0, 6.0)
    middle = ray.mean(axis=0) + np.array([*draw.uniform(-100.0, 100.0, 2), 0.0])
    circle = middle + size * np.column_stack([np.sin(angle), np.cos(angle), 0.0 * angle])
    add(t, distance_db(circle) - distance_db(ray))


def barometer_jumps(t: Table, size: float, draw: Draw) -> None:
    """The barometric height jumps in flight, as after a hatch or a motor changed the pressure."""
    time = seconds(t)
    t["mZ"] = t["mZ"] + size * (time > draw.uniform(0.25, 0.6) * time[-1])


def gnss_wanders(t: Table, size: float, draw: Draw) -> None:
    """Multipath moves the logged position about, with a memory of a minute."""
    time = seconds(t)
    t["mX"] = t["mX"] + size * wandering(time, draw, 60.0) / EAST_M
    t["mY"] = t["mY"] + size * wandering(time, draw, 60.0) / NORTH_M


def tower_tilts(t: Table, size: float, draw: Draw) -> None:
    """A storm has tilted the tower's dipole by some degrees."""
    ray = offset_m(t)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    tilt, side = np.radians(size), draw.uniform(0.0, 2.0 * np.pi)
    along = ray @ [np.sin(tilt) * np.sin(side), np.sin(tilt) * np.cos(side), np.cos(tilt)]
    add(t, 10.0 * np.log10((1.02 - along**2) / (1.02 - ray[:, 2] ** 2)))


def switch_slips(t: Table, size: float, draw: Draw) -> None:
    """The antenna switch loses its phase, and the two channels are exchanged after a share of the flight."""
    if len(names := levels(t)) == 2:
        late = seconds(t) > size * seconds(t)[-1]
        first, second = t[names[0]], t[names[1]]
        t[names[0]], t[names[1]] = np.where(late, second, first), np.where(late, first, second)


def clock_jumps(t: Table, size: float, draw: Draw) -> None:
    """The radio's clock is set right in flight, and its stamps are late before that."""
    time = seconds(t)
    take(t, np.searchsorted(time, time - size * (time < draw.uniform(0.3, 0.6) * time[-1])))


def lost_buffers(t: Table, size: float, draw: Draw) -> None:
    """The radio counts samples as time and loses eight buffers, so that its levels come ever earlier."""
    time = seconds(t)
    lost = np.searchsorted(np.sort(draw.uniform(0.0, time[-1], 8)), time)
    take(t, np.minimum(np.searchsorted(time, time + size / 8.0 * lost), len(time) - 1))


def motor_noise(t: Table, size: float, draw: Draw) -> None:
    """Noise of the motors desensitises the receiver in proportion to the speed."""
    time = seconds(t)
    step = np.hypot(np.gradient(t["mX"] * EAST_M), np.gradient(t["mY"] * NORTH_M)) / np.maximum(np.gradient(time), 0.01)
    speed = np.convolve(np.pad(step, 20, mode="edge"), np.full(41, 1.0 / 41.0), mode="valid")
    add(t, -size * np.clip(speed / np.nanquantile(speed, 0.95), 0.0, 1.2))


def wraps(t: Table, size: float, draw: Draw) -> None:
    """A register overflows: the strongest share of the levels is logged 32 dB too low."""
    for name in levels(t):
        t[name] = t[name] - 32.0 * (t[name] > np.nanquantile(t[name], 1.0 - size))


def compass_deviates(t: Table, size: float, draw: Draw) -> None:
    """Iron near the compass bends the heading by an angle that changes during the flight."""
    if "mYaw" in t:
        time = seconds(t)
        t["mYaw"] = t["mYaw"] + size * np.sin(2.0 * np.pi * time / 300.0 + np.radians(t["mYaw"]) + draw.uniform(0, 6))


def tower_drives(t: Table, size: float, draw: Draw) -> None:
    """The transmitter is on a car that drives away by some metres during the flight."""
    time, angle = seconds(t), draw.uniform(0.0, 2.0 * np.pi)
    moved = size * np.outer(time / time[-1], [np.sin(angle), np.cos(angle)])
    add(t, distance_db(offset_m(t, moved)) - distance_db(offset_m(t)))


def two_receivers(t: Table, size: float, draw: Draw) -> None:
    """A column mixes the rows of two receivers, one of them less sensitive."""
    add(t, -size * (draw.random(len(seconds(t))) < 0.4), [str(draw.choice(levels(t)))])


def held_while_weak(t: Table, size: float, draw: Draw) -> None:
    """The receiver repeats its last reading while the level is in the weakest share."""
    for name in levels(t):
        good = t[name] > np.nanquantile(t[name], size)
        take(t, np.maximum.accumulate(np.where(good, np.arange(len(good)), 0)), [name])


def path_losses(t: Table, size: float, draw: Draw) -> None:
    """The log contains path losses, the transmit power minus the level."""
    for name in levels(t):
        t[name] = size - t[name]


KINDS: Mapping[str, Outside] = {
    "ratcheting gain control": Outside(ratchet, (4.0, 9.0, 18.0), "dB", ("gain step",)),
    "intermittent contact": Outside(contact, (5.0, 10.0, 20.0), "dB"),
    "interference on one channel": Outside(interference, (0.0, 8.0, 16.0), "dB"),
    "second transmitter": Outside(second_transmitter, (-6.0, 3.0, 12.0), "dB", ("floor", "place", "tower")),
    "growing ice": Outside(ice, (4.0, 8.0, 16.0), "dB"),
    "swaying mast": Outside(mast_sways, (2.0, 4.0, 8.0), "dB"),
    "compression": Outside(compression, (0.7, 0.5, 0.3), "dB per dB", ("saturation",)),
    "warming receiver": Outside(warming, (3.0, 6.0, 12.0), "dB"),
    "stamps cut to periods": Outside(rounded_stamps, (5.0, 10.0, 20.0), "s", ("clock",)),
    "power schedule": Outside(power_schedule, (2.0, 5.0, 10.0), "dB"),
    "duty cycle": Outside(duty_cycle, (0.1, 0.3, 0.6), "share", ("no detection", "lock")),
    "repeated rows": Outside(repeated_rows, (60.0, 120.0, 240.0), "s"),
    "trailing mean": Outside(trailing_mean, (10.0, 30.0, 60.0), "s", ("clock",)),
    "peak hold": Outside(peak_hold, (10.0, 30.0, 90.0), "s"),
    "mixed units": Outside(mixed_units, (0.05, 0.2, 0.5), "share"),
    "polarisation in banks": Outside(bank, (1.0, 3.0, 8.0), "dB at 10 degrees", ("pattern", "attitude")),
    "blocked body sector": Outside(body_sector, (30.0, 60.0, 120.0), "degrees", ("pattern", "blocked")),
    "levels of another day": Outside(another_day, (60.0, 120.0, 200.0), "m"),
    "barometer jumps": Outside(barometer_jumps, (15.0, 40.0, 90.0), "m", ("height",)),
    "wandering position": Outside(gnss_wanders, (10.0, 30.0, 90.0), "m", ("place",)),
    "tilted tower antenna": Outside(tower_tilts, (15.0, 35.0, 70.0), "degrees", ("pattern",)),
    "switched channels": Outside(switch_slips, (0.7, 0.5, 0.25), "share", ("channels",)),
    "clock set in flight": Outside(clock_jumps, (3.0, 8.0, 20.0), "s", ("clock",)),
    "lost buffers": Outside(lost_buffers, (6.0, 15.0, 40.0), "s", ("clock",)),
    "noise of the motors": Outside(motor_noise, (3.0, 6.0, 12.0), "dB"),
    "register overflow": Outside(wraps, (0.02, 0.1, 0.3), "share", ("saturation",)),
    "deviating compass": Outside(compass_deviates, (20.0, 50.0, 120.0), "degrees", ("heading",)),
    "driving transmitter": Outside(tower_drives, (80.0, 200.0, 500.0), "m", ("place", "tower")),
    "two receivers in a column": Outside(two_receivers, (4.0, 8.0, 16.0), "dB"),
    "readings held while weak": Outside(held_while_weak, (0.15, 0.35, 0.6), "share", ("floor", "no detection", "lock")),
    "path losses": Outside(path_losses, (0.0, 10.0, 40.0), "dBm", ("sign",)),
}
