"""The same paths under other assumptions: antennas, attitude, foliage; fields alone are evaluated again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..common.units import FloatArray
from ..compare.offset import expected_offset_db, read_reference_powers, reference_power_dbm
from ..flight.data import RssSeries
from ..flight.learned_gain import pair_db
from ..flight.losses import path_loss
from ..flight.replay import Replayed, attitude_rotation, fields_from
from ..flight.settings import PortSettings, ReferencePowers, RtSettings
from ..propagation.arrays import Array, Link, Poses
from ..propagation.field.foliage import LEAFLESS_FACTOR, P833, P833_TABLE
from ..propagation.field.sum import Fields, mean_pair_power, rss_dbm
from ..propagation.options import Loss
from ..site.antennas import Isotropic
from ..site.installed import InstalledPattern
from ..site.site import Site

RssField = Literal["coherent", "power", "local_mean"]
"""Which simulated level is compared: values of ``rss.field``."""


def evaluate(
    site: Site, replayed: Replayed, loss: Loss | None, *, link: Link | None = None, poses: Poses | None = None
) -> Fields:
    """Fields over the paths that the replay found, with another link, attitude or loss.

    Parameters
    ----------
    site : Site
        Towers and their positions.
    replayed : Replayed
        Its paths are taken as they are.
    loss : callable or None
        Loss per path [dB], as :func:`aerpaw_cmp.flight.losses.path_loss` gives it.
    link, poses : optional
        In place of those of the replay; as many poses.

    Returns
    -------
    Fields
        H (poses, towers, n_rx, n_tx) and the power of each path.
    """
    link, poses = link or replayed.link, poses or replayed.poses
    return fields_from(replayed.source_m(site), replayed.replay.faces, replayed.replay.paths, link, poses, loss)


def level_dbm(link: Link, fields: Fields, field: RssField) -> FloatArray:
    """RSS (poses,) of the one tower of a series, coherent or power sum as ``rss.field`` says [dBm]."""
    power = fields.power if field == "power" else mean_pair_power(fields.h)
    return rss_dbm(power, link.transmit_power_dbm, link.noise_floor_dbm)[:, 0]


def rss_alternatives(site: Site, rt: RtSettings, replayed: Replayed, field: RssField) -> dict[str, FloatArray]:
    """Levels at the replayed poses under other assumptions; only those that could differ.

    Parameters
    ----------
    site : Site
    rt : RtSettings
        As the flight was replayed.
    replayed : Replayed
        One series.
    field : {"coherent", "power", "local_mean"}
        Which simulated level is compared.

    Returns
    -------
    dict of str to (poses,)
        By what is assumed [dBm].
    """
    link, loss = replayed.link, path_loss(site, rt, replayed.link.carrier_hz)
    changed: dict[str, tuple[Link, Poses]] = {}
    arrays = [*link.tower_arrays.values(), link.uav_array]
    if any(isinstance(p, InstalledPattern) for a in arrays for p in a.patterns):
        changed["antennas as measured, without added gain"] = (with_patterns(link, without_added_gain), replayed.poses)
    if any(p.name != "iso" for a in arrays for p in a.patterns):
        changed["isotropic antennas"] = (with_patterns(link, lambda _: Isotropic()), replayed.poses)
    if replayed.track is not None and any(p.name != "iso" for p in link.uav_array.patterns):
        for mode, name in (("logged", "logged attitude"), ("level", "heading only"), ("ignored", "attitude ignored")):
            if mode != rt.attitude:
                rotation = attitude_rotation(replayed.track, mode)
                changed[name] = (link, Poses(replayed.poses.position_m, np.ascontiguousarray(rotation)))
    levels = {
        name: level_dbm(other, evaluate(site, replayed, loss, link=other, poses=poses), field)
        + pair_db(other, poses, replayed.source_m(site))
        for name, (other, poses) in changed.items()
    }
    return levels


def with_patterns(link: Link, change: Callable[[Any], Any]) -> Link:
    """A link whose elements have changed patterns."""

    def other(array: Array) -> Array:
        return dataclasses.replace(array, patterns=tuple(change(p) for p in array.patterns))

    arrays = {name: other(array) for name, array in link.tower_arrays.items()}
    return dataclasses.replace(link, tower_arrays=arrays, uav_array=other(link.uav_array))


def without_added_gain(pattern: Any) -> Any:
    """The pattern as measured, without the gain that mast or airframe adds."""
    return pattern.base if isinstance(pattern, InstalledPattern) else pattern


def foliage_notes(trees: int, rt: RtSettings, carriers_hz: Collection[float]) -> tuple[str, ...]:
    """What a report must say of its foliage models, where the site has trees: how far they are stretched or assumed."""
    if not trees or rt.foliage != "attenuating":
        return ()
    notes = []
    if rt.foliage_model == "p833" and (rt.advanced.gamma_db_per_m is None or rt.advanced.maximum_loss_db is None):
        notes += [note for carrier in sorted(carriers_hz) if (note := p833_note(carrier))]
    if rt.leaves == "out":
        what = "gamma" if rt.foliage_model == "p833" else "the loss"
        notes.append(
            f"Trees out of leaf: {what} in leaf divided by {1 / LEAFLESS_FACTOR:g}. That is an assumption of this "
            "tool: ITU-R P.833 gives about 20 % near 1 GHz, and no number at this carrier."
        )
    return tuple(notes)


def p833_note(carrier_hz: float) -> str | None:
    """That P.833's table is continued beyond its end, or None within it."""
    low, high = P833_TABLE[0][0], P833_TABLE[-1][0]
    if low <= carrier_hz / 1e6 <= high:
        return None
    model = P833.at(carrier_hz)
    return (
        f"Trees at {carrier_hz / 1e9:g} GHz: an extrapolation of ITU-R P.833, whose table of woodland covers {low:g} "
        f"to {high:g} MHz. Continued it gives gamma = {model.gamma_db_per_m:.2f} dB/m and A_m = {model.maximum_db:.0f} "
        "dB in leaf; other continuations give 0.45 to 0.7 dB/m at 3.4 GHz, so treat gamma as a sensitivity."
    )


def expected_offset(
    budget: ReferencePowers | None, folder: Path, series: RssSeries
) -> tuple[float, float, float] | None:
    """Offset that the USRP reference powers predict for a series [dB], and those of receiver and transmitter [dBm].

    None where the flight file (``rss.reference_powers``, its table below ``folder``) has none for the channel.

    Raises
    ------
    InputError
        If the table cannot be read.
    """
    receiver = None if budget is None else budget.receivers.get(series.channel)
    if budget is None or receiver is None:
        return None
    table = read_reference_powers(folder / budget.file)
    carrier = series.link.carrier_hz

    def reference(port: PortSettings, category: Any) -> float:
        return reference_power_dbm(
            table, node=port.node, category=category, channel=port.channel, gain_db=port.gain_db,
            frequency_hz=carrier, amplifier=port.amplifier,
        )  # fmt: skip

    received = reference(receiver, "rx")
    if budget.receiver_gain_removed:  # the log holds dB re full scale minus the gain setting
        received += receiver.gain_db
    sent = reference(budget.transmitter, "tx") if budget.transmitter else series.link.transmit_power_dbm
    expected = expected_offset_db(
        receiver_reference_dbm=received,
        transmitter_reference_dbm=sent,
        simulated_transmit_dbm=series.link.transmit_power_dbm,
        transmit_amplitude_dbfs=budget.transmit_amplitude_dbfs,
        transmit_gain_db=budget.transmitter.extra_gain_db if budget.transmitter else 0.0,
        receive_gain_db=receiver.extra_gain_db,
    )
    return expected, received, sent
