"""The antennas and the receiver that flight.yaml names from the memory of a site: found there, checked, made files.

Reading flight.yaml opens no table; a job that replays or lists its inputs takes this stage after it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...common.errors import InputError, UsageError, parsing
from ...site.antenna.learned import BAND, Named, find_named, read_table
from ...site.antenna.sphere_pattern import read_sphere_csv
from ..settings import AntennaSettings, ArraySettings, FlightFile, LinkSettings, load_flight


def load_with_learned(path: str | Path, learned: Path | None = None) -> FlightFile:
    """A flight.yaml as :func:`~aerpaw_cmp.flight.settings.load_flight` reads it, with what its site remembers."""
    return with_learned(load_flight(path, learned), Path(path).parent)


def with_learned(settings: FlightFile, folder: Path) -> FlightFile:
    """The settings with the antennas and the receiver that they name from the memory of a site, as files.

    What cannot be used (no such entry, a damaged memory, another band) is left out, and ``flight.notes`` say so: the
    report goes on without it.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Of the flight file, where sites that are not packaged lie.
    """
    notes: list[str] = []
    content: dict[str, Any] = {}
    channels = dict(settings.link.channels)
    # the airframe last: it belongs to every channel, also to those that antennas of towers bring
    for key, name in sorted(settings.antennas.items(), key=lambda item: item[0] == "uav"):
        try:
            named = find_named(name, folder)
            channels |= _with_antenna(settings, channels, key, named)
        except (InputError, UsageError) as error:
            notes.append(f"antennas.{key}: {_reason(error)}; isotropic in its place")
    if channels != settings.link.channels:
        content["link"] = settings.link.model_copy(update={"channels": channels})
    receiver = settings.rank.receiver
    if receiver is not None and "/" in receiver and not (folder / receiver).is_file():
        try:
            content["rank"] = settings.rank.model_copy(
                update={"receiver": _receiver_file(find_named(receiver, folder))}
            )
        except (InputError, UsageError) as error:
            if Path(receiver).suffix != ".json":  # else a file of another place: reading it says what is wrong
                notes.append(f"rank.receiver: {_reason(error)}; not used")
                content["rank"] = settings.rank.model_copy(update={"receiver": None})
    if notes:
        content["flight"] = settings.flight.model_copy(update={"notes": [*settings.flight.notes, *notes]})
    return settings.model_copy(update=content) if content else settings


def _reason(error: InputError | UsageError) -> str:
    """Reason for an error: what was found, in which file, and what was expected instead."""
    where = f" in {Path(error.path).name}" if error.path else ""
    return f"{error.found}{where}; expected: {error.expected}"


def _receiver_file(named: Named) -> str:
    """File of a learned rank receiver that can be read and was made from the logs that its entry names."""
    if not named.entry.receivers:
        raise UsageError("the entry has no rank receiver", expected="one learned from ranks")
    path = named.folder / named.entry.receivers[0].file
    with parsing(path, "a rank receiver"):
        content = json.loads(read_table(path, "a rank receiver"))
    check_logs(content.get("trained_on", []) if isinstance(content, dict) else [], named, path)
    return str(path)


def check_logs(trained_on: Sequence[str], named: Named, path: Path) -> None:
    """Refuse a table that was learned from logs which its entry does not name: scores would trust the wrong ones."""
    strange = set(trained_on) - set(named.entry.trained_on)
    if strange:
        raise InputError(
            f"learned from logs (SHA-256 {min(strange)[:12]}...) that its entry does not name",
            expected="the table that was written with the entry",
            cause="a table of another calibration",
            path=path,
        )


def _with_antenna(
    settings: FlightFile, channels: Mapping[str, LinkSettings], key: str, named: Named
) -> dict[str, LinkSettings]:
    """Links of the channels that a learned antenna belongs to.

    Raises
    ------
    UsageError
        No antenna of that name for this end, or one of another band.
    InputError
        A table that is damaged, or learned from other logs than its entry says.
    """
    end = "uav" if key == "uav" else "tower"
    tower, _, channel = key.partition(".")
    names = [channel] if end == "tower" else list(channels) or [s.channel for s in named.entry.series]
    out = {}
    for name in names:
        link = channels.get(name, settings.link.rss)
        series = named.antenna(tower, name, end)
        if series is None:
            raise UsageError(f"no learned antenna of {key}", expected="one that the entry has")
        if abs(link.carrier_hz / series.carrier_hz - 1.0) > BAND:
            raise UsageError(
                f"learned at {series.carrier_hz / 1e9:g} GHz, used at {link.carrier_hz / 1e9:g} GHz",
                expected="an antenna of the same band",
            )
        path = named.folder / (series.uav_file if end == "uav" else series.tower_file)
        check_logs(read_sphere_csv(path).trained_on, named, path)
        antenna = AntennaSettings(model="sphere", file=str(path))
        if end == "uav":
            out[name] = link.model_copy(update={"uav": ArraySettings(antenna=antenna)})
        else:
            out[name] = link.model_copy(update={"towers": {**link.towers, tower: ArraySettings(antenna=antenna)}})
    return out
