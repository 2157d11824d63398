"""Tables to which a name leads in the memory of a site, checked: of the same band, learned from the logs it says."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from ...common.errors import InputError, UsageError, parsing
from .learned import AIRFRAME_BAND, BAND, LearnedAntenna, LearnedPair, Named, read_table
from .pair_gain import read_pair
from .sphere_pattern import read_sphere_csv


def learned_antenna(named: Named, end: str, carrier_hz: float) -> tuple[Path, LearnedAntenna]:
    """Return the table of a learned antenna and its error model.

    Parameters
    ----------
    named : Named
    end : {"uav", "tower"}
    carrier_hz : float
        At which it is to be used [Hz].

    Raises
    ------
    UsageError
        No antenna of that name for this end, or one of another band.
    InputError
        A table that is damaged, not as it was written, or learned from other logs than its entry names.
    """
    series = named.antenna(end, carrier_hz)
    if series is None:
        raise UsageError("the entry has no such antenna", expected="one that the entry has")
    _check_band(series.carrier_hz, carrier_hz, AIRFRAME_BAND if end == "uav" else BAND)
    file = series.uav_file if end == "uav" else series.tower_file
    path, written = named.folder / file, named.written(file)
    check_logs(read_sphere_csv(path, written).trained_on, named, path)
    pair = series.pair
    if pair is not None:
        read_pair(named.folder / pair.file, pair.length, pair.prior_sd_db, named.written(pair.file))
        pair = LearnedPair(
            file=str(named.folder / pair.file), sha256=named.entry.tables[pair.file], length=pair.length,
            prior_sd_db=pair.prior_sd_db,
        )  # fmt: skip
    return path, LearnedAntenna(
        sha256=written.sha256, command=written.command, pair=pair if end == "tower" else None, spread=series.spread
    )


def _check_band(learned_hz: float, used_hz: float, band: float) -> None:
    if abs(used_hz / learned_hz - 1.0) > band:
        raise UsageError(
            f"learned at {learned_hz / 1e9:g} GHz, used at {used_hz / 1e9:g} GHz",
            expected=f"a carrier within {100 * band:g} %: farther bands were not compared",
        )


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
    _check_band(named.entry.receivers[0].carrier_hz, carrier_hz, BAND)
    path = named.folder / named.entry.receivers[0].file
    with parsing(path, "a rank receiver"):
        content = json.loads(read_table(path, "a rank receiver", named.written(path.name)))
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
