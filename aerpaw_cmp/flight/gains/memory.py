"""The antennas and the receiver that flight.yaml names from the memory of a site: found there, checked, made files.

Reading flight.yaml opens no table; a job that replays or lists its inputs takes this stage after it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ...common.errors import InputError, UsageError
from ...site.antenna.learned import Named, UnknownName, find_named
from ...site.antenna.named import learned_antenna, receiver_file
from ..overrides import Overrides, overridden
from ..settings import AntennaSettings, ArraySettings, Caution, FlightFile, LinkSettings, joined, load_flight


def load_with_learned(path: str | Path, learned: Path | None = None, overrides: Overrides | None = None) -> FlightFile:
    """Return the settings of a flight.yaml with the learned antennas and receiver that it names, as files.

    Parameters
    ----------
    path : str or Path
    learned : Path, optional
        calibrated.yaml whose settings take the place of those of the flight file, and of the antennas that it names.
    overrides : mapping, optional
        Dotted keys with other values: they come before the antennas, whose band must fit the carrier.
    """
    settings = with_learned(overridden(load_flight(path), overrides or {}), Path(path).parent)
    return settings if learned is None else joined(settings, learned)


def flight_of(path: Path) -> FlightFile | None:
    """Return the settings of the flight file that a path names, or None for any other file."""
    if path.suffix.lower() not in (".yaml", ".yml") or not path.is_file():
        return None
    text = path.read_text(encoding="utf-8", errors="replace")
    return load_with_learned(path) if re.search(r"^flight\s*:", text, re.MULTILINE) else None


@dataclass(slots=True)
class _Ends:
    """Links of a flight, to which learned antennas are added, and those that do not fit."""

    rss: LinkSettings
    channels: dict[str, LinkSettings]
    cautions: list[Caution] = field(default_factory=list)
    used: set[str] = field(default_factory=set)

    def link(self, channel: str | None) -> LinkSettings:
        """Return the link of a channel; that of ``link.rss`` for None and for a channel without an entry."""
        return self.rss if channel is None else self.channels.get(channel, self.rss)

    def use(self, key: str, channel: str | None, name: str, named: Named) -> None:
        """Put a learned antenna at the end that a key names; a channel of None is the link of all other channels."""
        tower, link = key.partition(".")[0], self.link(channel)
        before = link.uav if key == "uav" else link.towers.get(tower, link.tower)
        instead = "an isotropic antenna is used instead" if before == ArraySettings() else "that of 'link' is used"
        try:
            file, known = learned_antenna(named, "uav" if key == "uav" else "tower", link.carrier_hz)
        except (InputError, UsageError) as error:
            text = f"the learned antenna {name} is not used ({_reason(error)}); {instead}"
            self.cautions.append(Caution(key=f"antennas.{key}", channel=channel, text=text))
            return
        if before != ArraySettings():
            text = f"the learned antenna {name} replaces the array of 'link'"
            self.cautions.append(Caution(key=f"antennas.{key}", channel=channel, text=text, used=True))
        array = ArraySettings(antenna=AntennaSettings(model="sphere", file=str(file), learned=known))
        end: dict[str, Any] = {"uav": array} if key == "uav" else {"towers": {**link.towers, tower: array}}
        self.used.add(key)
        if channel is None:
            self.rss = link.model_copy(update=end)
        else:
            self.channels[channel] = link.model_copy(update=end)


def with_learned(settings: FlightFile, folder: Path) -> FlightFile:
    """Return the settings with the learned antennas and the receiver that they name, as files.

    The airframe (``antennas.uav``) is the UAV's end of every channel. What does not fit (another band, a damaged
    table) is not used: :attr:`.FlightFile.cautions` has the reasons, and the run continues.

    Parameters
    ----------
    settings : FlightFile
    folder : Path
        Folder of the flight file, which may contain sites that are not packaged.

    Raises
    ------
    UnknownName
        A name that no learned model has, or one for another end.
    UsageError
        A key of ``antennas`` that is neither ``uav`` nor ``TOWER.CHANNEL``.
    """
    ends = _Ends(settings.link.rss, dict(settings.link.channels))
    # the airframe last: it belongs to every channel, also to those that antennas of towers bring
    for key, name in sorted(settings.antennas.items(), key=lambda item: item[0] == "uav"):
        tower, _, channel = key.partition(".")
        if key != "uav" and not (tower and channel):
            raise UsageError(f"unknown key 'antennas.{key}'", expected="'uav' or 'TOWER.CHANNEL', such as LW1.USRP1")
        named = _named(name, folder, "uav" if key == "uav" else "tower", f"antennas.{key}")
        for each in (None, *list(ends.channels)) if key == "uav" else (channel,):
            if isinstance(named, Caution):
                ends.cautions.append(replace(named, channel=each))
            else:
                ends.use(key, each, name, named)
    content: dict[str, Any] = {}
    if ends.used:
        link = {"rss": ends.rss, "channels": ends.channels} if ends.channels else {"rss": ends.rss}
        content["link"] = settings.link.model_copy(update=link)
    if settings.antennas:
        content["antennas"] = {key: name for key, name in settings.antennas.items() if key in ends.used}
    receiver = settings.rank.receiver
    if receiver is not None and "/" in receiver and not (folder / receiver).is_file():
        content["rank"] = settings.rank.model_copy(update={"receiver": _receiver(settings, receiver, folder, ends)})
    lent = ends.channels.keys() - settings.link.channels.keys()
    return settings.changed(content, cautions=ends.cautions, lent=lent) if content or ends.cautions else settings


def antennas_used(series: Sequence[tuple[str, str, LinkSettings]]) -> tuple[str, ...]:
    """Return a sentence per pair of antennas: its names, and the channels that are replayed with it if others are not.

    Examples
    --------
    >>> antennas_used([("LW1", "A", LinkSettings(carrier_hz=3.3e9)), ("LW1", "B", LinkSettings(carrier_hz=3.3e9))])
    ('Antennas: isotropic at the tower, isotropic at the UAV.',)
    """
    pairs: dict[str, list[str]] = {}
    for tower, channel, link in series:
        ends = (_antenna_name(array.antenna) for array in (link.towers.get(tower, link.tower), link.uav))
        pairs.setdefault("{} at the tower, {} at the UAV".format(*ends), []).append(f"{tower} {channel}")
    if len(pairs) == 1:
        return (f"Antennas: {next(iter(pairs))}.",)
    return tuple(f"Antennas of {', '.join(names)}: {what}." for what, names in pairs.items())


def _antenna_name(antenna: AntennaSettings) -> str:
    if antenna.file is None:
        return {"iso": "isotropic"}.get(antenna.model, antenna.model)
    return Path(antenna.file).name.removesuffix(".gz").removesuffix(".csv")


def _named(name: str, folder: Path, end: str, key: str) -> Named | Caution:
    """Return the entry of a name, or the reason why the learned models cannot be read."""
    try:
        return find_named(name, folder, end)
    except UnknownName as error:
        raise UnknownName(f"{key}: {error.found}", expected=error.expected, cause=error.cause) from None
    except (InputError, UsageError) as error:
        return Caution(key=key, channel=None, text=f"{name} is not used ({_reason(error)})")


def _receiver(settings: FlightFile, name: str, folder: Path, ends: _Ends) -> str | None:
    """Return the file of a rank receiver; None, with the reason in ``ends``, if it does not fit."""
    if Path(name).suffix == ".json":  # a file that is missing: reading it reports that
        return name
    named = _named(name, folder, "receiver", "rank.receiver")
    if not isinstance(named, Caution):
        try:
            return str(receiver_file(named, settings.link.rank.carrier_hz))
        except (InputError, UsageError) as error:
            named = Caution(key="rank.receiver", channel="rank", text=f"{name} is not used ({_reason(error)})")
    ends.cautions.append(named)
    return None


def _reason(error: InputError | UsageError) -> str:
    """Return what was found, in which file, and what was expected instead."""
    where = f" in {Path(error.path).name}" if error.path else ""
    return f"{error.found}{where}; expected: {error.expected}"
