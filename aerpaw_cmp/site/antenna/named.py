"""Tables to which a name leads in the memory of a site, checked: of the same band, learned from the logs it says."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ...common.errors import InputError, UsageError, parsing
from .learned import BAND, Named, read_table
from .sphere_pattern import read_sphere_csv


def antenna_file(named: Named, key: str, channel: str, carrier_hz: float) -> Path:
    """File of a learned antenna.

    Parameters
    ----------
    named : Named
    key : str
        ``uav`` or ``TOWER.CHANNEL``.
    channel : str
    carrier_hz : float
        At which it is to be used [Hz].

    Returns
    -------
    Path

    Raises
    ------
    UsageError
        No antenna of that name for this end, or one of another band.
    InputError
        A table that is damaged, or learned from other logs than its entry says.
    """
    end = "uav" if key == "uav" else "tower"
    series = named.antenna(key.partition(".")[0], channel, end)
    if series is None:
        raise UsageError(f"no learned antenna of {key}", expected="one that the entry has")
    _check_band(series.carrier_hz, carrier_hz, "an antenna of the same band")
    path = named.folder / (series.uav_file if end == "uav" else series.tower_file)
    check_logs(read_sphere_csv(path).trained_on, named, path)
    return path


def _check_band(learned_hz: float, used_hz: float, expected: str) -> None:
    if abs(used_hz / learned_hz - 1.0) > BAND:
        raise UsageError(f"learned at {learned_hz / 1e9:g} GHz, used at {used_hz / 1e9:g} GHz", expected=expected)


def receiver_file(named: Named, carrier_hz: float) -> Path:
    """Return the file of a learned rank receiver of the same band, which was made from the logs that its entry names.

    Parameters
    ----------
    named : Named
        An entry with a receiver.
    carrier_hz : float
        Carrier of the rank link [Hz].

    Raises
    ------
    UsageError
        A receiver of another band.
    InputError
        A table that is damaged, or learned from other logs than its entry says.
    """
    _check_band(named.entry.receivers[0].carrier_hz, carrier_hz, "a receiver of the same band")
    path = named.folder / named.entry.receivers[0].file
    with parsing(path, "a rank receiver"):
        content = json.loads(read_table(path, "a rank receiver"))
    check_logs(content.get("trained_on", []) if isinstance(content, dict) else [], named, path)
    return path


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
