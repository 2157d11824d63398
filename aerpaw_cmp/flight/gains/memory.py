"""The antennas and the receiver that flight.yaml names from the memory of a site: found there, checked, made files.

Reading flight.yaml opens no table; a job that replays or lists its inputs takes this stage after it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...common.errors import InputError, UsageError
from ...site.antenna.learned import Named, find_named
from ...site.antenna.named import antenna_file, receiver_file
from ..settings import AntennaSettings, ArraySettings, FlightFile, LinkSettings, load_flight


def load_with_learned(path: str | Path, learned: Path | None = None) -> FlightFile:
    """A flight.yaml as :func:`~aerpaw_cmp.flight.settings.load_flight` reads it, with what its site remembers."""
    settings = load_flight(path, learned)
    return with_learned(settings, Path(path).parent)


def flight_of(path: Path) -> FlightFile | None:
    """The flight file that a path names; None of any other file."""
    if path.suffix.lower() not in (".yaml", ".yml") or not path.is_file():
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    return load_with_learned(path) if re.search(r"^flight\s*:", text, re.MULTILINE) else None


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
                update={"receiver": str(receiver_file(find_named(receiver, folder)))}
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


def _with_antenna(
    settings: FlightFile, channels: Mapping[str, LinkSettings], key: str, named: Named
) -> dict[str, LinkSettings]:
    """Links of the channels that a learned antenna belongs to."""
    tower, _, channel = key.partition(".")
    # the airframe without any channel yet: those that it was learned with
    names = [channel] if key != "uav" else list(channels) or [s.channel for s in named.entry.series]
    out = {}
    for name in names:
        # a channel that nothing describes is the RSS link with another antenna
        link = channels.get(name, settings.link.rss)
        file = str(antenna_file(named, key, name, link.carrier_hz))
        array = ArraySettings(antenna=AntennaSettings(model="sphere", file=file))
        out[name] = link.model_copy(
            update={"uav": array} if key == "uav" else {"towers": {**link.towers, tower: array}}
        )
    return out
