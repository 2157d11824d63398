"""An antenna pattern for other programs: Sionna RT's custom pattern, MSI Planet's cuts, a table over the sphere."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...common.errors import UsageError
from .antennas import MeasuredPattern, check_power
from .learned import BAND
from .sphere_pattern import SpherePattern, planning_cuts, sphere_csv, sphere_grid

# As the cuts of planning tools are read: finer than any lobe that a flight can teach.
_STEP_DEG = 3.0


def exported(pattern: MeasuredPattern, name: str, target: Path, carrier_hz: float | None = None) -> str:
    """Text of a pattern in the format that the ending of a file says: ``.py`` (Sionna RT), ``.msi``, ``.csv``.

    What the pattern was learned from goes along as comments.

    Parameters
    ----------
    pattern : MeasuredPattern
    name : str
    target : Path
    carrier_hz : float, optional
        For ``.msi``, where the pattern has no frequency of its own.

    Returns
    -------
    str

    Raises
    ------
    UsageError
        Another ending; ``.msi`` without a frequency.
    """
    notes = getattr(pattern, "notes", "") or f"trained_on: {' '.join(pattern.trained_on)}" * bool(pattern.trained_on)
    lines = tuple(line.lstrip("# ") for line in notes.splitlines())
    if target.suffix == ".msi":
        frequency = pattern.frequency_hz or carrier_hz
        if not frequency or abs((carrier_hz or frequency) / frequency - 1.0) > BAND:
            found = f"the pattern has {f'{frequency / 1e9:g} GHz' if frequency else 'no frequency'}"
            raise UsageError(found, expected="--carrier HZ, within 2 % of the pattern's own", path=target)
        return planning_cuts(pattern, name, frequency, lines)
    theta, phi, _ = sphere_grid(_STEP_DEG)
    if target.suffix == ".csv":
        check_power(pattern, target)  # what the reader of spheres asks: two cuts may make more power than goes in
        at = np.meshgrid(np.radians(theta), np.radians(phi), indexing="ij")
        sd = pattern.gain_sd_db(*at) if isinstance(pattern, SpherePattern) else np.zeros(at[0].shape)
        return sphere_csv(pattern.gain_dbi(*at), sd, lines)
    if target.suffix == ".py":
        return _sionna_module(pattern, name, target, lines)
    raise UsageError(f"the ending {target.suffix!r}", expected=".py (Sionna RT), .msi or .csv", path=target)


def _sionna_module(pattern: MeasuredPattern, name: str, target: Path, notes: tuple[str, ...]) -> str:
    import base64

    theta, phi, _ = sphere_grid(_STEP_DEG)
    # closed at 360 deg: the module that is written interpolates within its table, not round its end
    at = np.meshgrid(np.radians(theta), np.radians(np.append(phi, 360.0)), indexing="ij")
    table = np.stack([part for field in pattern.field(*at) for part in (field.real, field.imag)], axis=-1)
    template = Path(__file__).with_name("sionna_pattern.txt").read_text(encoding="utf-8")
    return template.format(
        name=re.sub(r"\W", "_", name),
        module=re.sub(r"\W", "_", target.stem),
        # notes stand in a docstring: a quote or a backslash of a file name would end it
        notes="\n".join(re.sub(r'["\\]', "'", note) for note in notes),
        table=base64.b64encode(table.astype("<f4").tobytes()).decode("ascii"),
        shape=table.shape,
    )
