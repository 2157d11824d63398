"""Notes that must be given on foliage models: how far they are stretched or assumed."""

from __future__ import annotations

from collections.abc import Collection

from ...flight.settings import RtSettings
from ...propagation.field.foliage import LEAFLESS_FACTOR, P833, P833_TABLE


def foliage_notes(wooded: bool, rt: RtSettings, carriers_hz: Collection[float]) -> tuple[str, ...]:
    """Notes a report must give on its foliage models, if the site has trees: how far they are stretched or assumed."""
    if not wooded or rt.foliage != "attenuating":
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
