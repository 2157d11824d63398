"""The standard deviation that a further flight would leave, before anyone has flown it.

A Gaussian process does not ask for levels to say how well it will know a place: directions and positions of a planned
route are enough. Antennas are those of :mod:`.direction_gain`, what they leave is the field of :mod:`.field_gp`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.units import FloatArray
from ..gains.direction_gain import GainFit, GainModel, LinkSamples, fit_gain
from .field_gp import NEW_FLIGHT, FieldFit, FieldModel, Part, Rows

# Name of the flight to come.
_PLANNED = "planned"


@dataclass(frozen=True, kw_only=True)
class Known:
    """All that decides how well targets are known.

    Parameters
    ----------
    series : sequence of LinkSamples
        Of the flights that were flown; none: antennas are as the prior has them.
    model : GainModel
        Terms and strengths of the antennas, own nuisance, noise.
    field : FieldModel, optional
        Of what the antennas leave; None: nothing is added.
    """

    series: Sequence[LinkSamples]
    model: GainModel
    field: FieldModel | None = None

    def sd_db(self, route: Sequence[LinkSamples], targets: Mapping[str, LinkSamples]) -> dict[str, FloatArray]:
        """Standard deviation (targets,) of the level per antenna, about its mean over the targets [dB].

        Parameters
        ----------
        route : sequence of LinkSamples
            The planned flight at each antenna; levels are not used. None: as it stands.
        targets : mapping of str to LinkSamples
            By antenna.

        Returns
        -------
        dict of str to (targets,)
            Of antennas and field, without nuisance and noise of a later flight, which no route lowers.
        """
        # any levels: how well places will be known does not depend on them
        planned = [dataclasses.replace(s, flight=_PLANNED, residual_db=np.zeros(len(s))) for s in route]
        rows = [*self.series, *planned]
        fit = fit_gain(rows, self.model) if rows else None
        return {antenna: self._deviation_db(antenna, target, rows, fit) for antenna, target in targets.items()}

    def _deviation_db(
        self, antenna: str, target: LinkSamples, rows: Sequence[LinkSamples], fit: GainFit | None
    ) -> FloatArray:
        if fit is None or antenna not in fit.antennas:
            gain = np.full(len(target), math.sqrt(sum(t.sd_db**2 for t in self.model.terms)))
        else:
            gain = fit.sd_about_mean(target)
        if self.field is None:
            return gain
        mine = [(i, s.binned(self.model.bin_s)) for i, s in enumerate(rows) if s.antenna == antenna]
        if not mine:
            return np.asarray(np.hypot(gain, self.field.place_sd_db))
        known = Rows.joined([Rows.of(s, i) for i, s in mine])
        place: tuple[Part, ...] = ("place",)
        _, field_sd = FieldFit(self.field, known).predict(Rows.of(target, NEW_FLIGHT), place)
        return np.asarray(np.hypot(gain, field_sd))


def rms_db(sd_db: Mapping[str, FloatArray]) -> float:
    """Root mean square over all targets and antennas [dB]: the error to expect of the mean of a flight there."""
    return math.sqrt(float(np.mean(np.concatenate([sd**2 for sd in sd_db.values()]))))
