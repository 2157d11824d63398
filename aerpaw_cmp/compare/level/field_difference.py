"""The numbers of an audit of fields, and how those of several replays add up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldAudit:
    """Differences that the two references found.

    Parameters
    ----------
    paths, power_max_db, power_rms_db, phase_max_rad, phase_rms_rad
        Against Sionna's own coefficients: paths compared, worst and root-mean-square differences.
    link_rss_max_db : float
        Of the coherent RSS of links whose paths are all shorter than 300 m, against Sionna.
    reference_links, reference_paths, h_max_error, rss_max_error_db, rank_differs
        Against the second implementation: largest difference of H, relative; of RSS; links with another rank.
    attitude_rows, attitude_max_rad
        Logged attitudes turned into rotations a second time.
    missing_paths, phantom_paths : int
        Paths that a reference has and whose existence is beyond doubt; paths that cannot exist.
    doubtful : int
        Paths and links that were not judged, since a micrometre decides (float32: two millimetres).
    failures : tuple of str
        What is out of tolerance, in words.
    not_covered : tuple of str
    """

    paths: int = 0
    power_max_db: float = 0.0
    power_rms_db: float = 0.0
    phases: int = 0
    phase_max_rad: float = 0.0
    phase_rms_rad: float = 0.0
    link_rss_max_db: float = 0.0
    reference_links: int = 0
    reference_paths: int = 0
    h_max_error: float = 0.0
    rss_max_error_db: float = 0.0
    rank_differs: int = 0
    attitude_rows: int = 0
    attitude_max_rad: float = 0.0
    missing_paths: int = 0
    phantom_paths: int = 0
    doubtful: int = 0
    failures: tuple[str, ...] = ()
    not_covered: tuple[str, ...] = ()

    @property
    def failed(self) -> int:
        """Number of checks out of tolerance."""
        return len(self.failures)

    def __add__(self, other: FieldAudit) -> FieldAudit:
        """Both together: counts add up, the worst stays."""
        values: dict[str, Any] = {
            name: _together(name, getattr(self, name), getattr(other, name)) for name in self.__slots__
        }
        values["power_rms_db"] = _rms(self.paths, self.power_rms_db, other.paths, other.power_rms_db)
        values["phase_rms_rad"] = _rms(self.phases, self.phase_rms_rad, other.phases, other.phase_rms_rad)
        return FieldAudit(**values)


def _together(name: str, mine: Any, theirs: Any) -> Any:
    """Texts once each, the larger of two errors, the sum of two counts."""
    if isinstance(mine, tuple):
        return tuple(dict.fromkeys((*mine, *theirs)))
    worst = name.endswith(("_max_db", "_max_m", "_max_rad", "_max_error", "_max_error_db"))
    return max(mine, theirs) if worst else mine + theirs


def _rms(n: int, rms: float, m: int, other_rms: float) -> float:
    return float(math.sqrt((n * rms**2 + m * other_rms**2) / max(n + m, 1)))
