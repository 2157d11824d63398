"""Score predictions before any flight on real flights, without using their levels.

Each flight's track is predicted by ray tracing with isotropic antennas and the stated prior of
:class:`~aerpaw_cmp.jobs.sources.Prior`. One offset per flight is subtracted, because before a flight no power, cable
or receiver gain is known. The script prints the share of samples inside the 90 % band, the CRPS and the mean standard
deviation per campaign. For comparison, it prints the CRPS of free space with one constant standard deviation, which is
the best constant for all campaigns and so favours free space. The exit code is 1 if the pooled share is outside 82 to
96 %, if a campaign's share is below 75 %, or if free space has the better CRPS.

    python benchmarks/first_flight_prediction.py FIELD
"""

import argparse
import os
import sys
from pathlib import Path

import numpy as np

from aerpaw_cmp.compare.level import crps_normal
from aerpaw_cmp.flight.gains import load_with_learned
from aerpaw_cmp.flight.settings import LinkSettings
from aerpaw_cmp.jobs.calibrate import observe
from aerpaw_cmp.jobs.sources import PRIOR_SD_DB, NamedFlight, Prior

FLIGHTS = Path(__file__).parents[1] / "tests" / "field"
CAMPAIGNS = {
    "dataset 12": ["learned/ds12_40m_fs10MHz", "learned/ds12_40m_fs5MHz", "learned/ds12_70m_fs20MHz"],
    "LTE": ["calibrations/lte50", "calibrations/lte90"],
    "AFAR": [
        f"calibrations/afar{name}"
        for name in ("300_loc_1", "300_loc_2", "309_loc_2", "328_loc_1", "328_loc_3", "288_loc_1")
    ],
    "AADM": ["aadm"],
}  # fmt: skip
BAND_90 = 1.6449


def errors(path: Path, field: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors of ray tracing and of free space after one offset each, and the stated SD, all (n,) [dB]."""
    data = NamedFlight(path, load_with_learned(path)).load(field)
    traced, free, sd = [], [], []
    for o in observe([data])[0]:
        good = np.isfinite(o.samples.residual_db)
        if o.samples.tower not in data.site.towers or not good.any():
            continue
        samples = o.samples.part(good)
        carrier_hz = next(s.link.carrier_hz for s in data.rss if s.channel == samples.channel)
        prior = Prior(data.site, LinkSettings(carrier_hz=carrier_hz))
        level = prior.sources()[f"{samples.tower}.level"].replayed_db(samples)
        slow = np.hypot(PRIOR_SD_DB["antennas"], PRIOR_SD_DB["shadowing"]) + 0.0 * level
        traced.append(samples.residual_db - level)
        free.append(samples.residual_db)
        sd.append(prior.fading("").total_db(slow))
    both = np.concatenate(traced), np.concatenate(free), np.concatenate(sd)
    known = np.isfinite(both[0])
    error, plain, stated = (values[known] for values in both)
    return error - error.mean(), plain - plain.mean(), stated


def score(error: np.ndarray, sd: np.ndarray) -> float:
    """Return the mean CRPS of errors (n,) with a normal distribution [dB]."""
    return float(np.mean(crps_normal(error, sd)))


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = os.environ.get("AERPAW_CMP_FIELD_DATA")
    parser.add_argument("field", type=Path, nargs="?" if known else None, default=known, help="folder of real logs")
    field = parser.parse_args().field
    scored = {
        name: [errors(FLIGHTS / f"{flight}.yaml", field) for flight in flights] for name, flights in CAMPAIGNS.items()
    }
    every = [flight for flights in scored.values() for flight in flights]
    constants = np.arange(4.0, 20.0, 0.5)
    totals = [np.mean([score(free, np.full(len(free), sd)) for _, free, _ in every]) for sd in constants]
    constant = float(constants[int(np.argmin(totals))])
    print(f"free space: one constant standard deviation, {constant:g} dB\n")
    print(f"{'campaign':12} {'flights':>7} {'inside 90 %':>11} {'CRPS':>6} {'free space':>10} {'mean SD':>8}")
    shares = {}
    for name, flights in scored.items():
        inside = [float(np.mean(np.abs(error) <= BAND_90 * sd)) for error, _, sd in flights]
        crps = [(score(error, sd), score(free, np.full(len(free), constant))) for error, free, sd in flights]
        shares[name] = float(np.mean(inside))
        mean = float(np.mean([sd.mean() for _, _, sd in flights]))
        ours, theirs = np.mean(crps, axis=0)
        print(f"{name:12} {len(flights):7} {shares[name]:11.3f} {ours:6.2f} {theirs:10.2f} {mean:8.1f}")
    pooled = float(np.mean([np.mean(np.abs(error) <= BAND_90 * sd) for error, _, sd in every]))
    ours = float(np.mean([score(error, sd) for error, _, sd in every]))
    print(f"{'pooled':12} {len(every):7} {pooled:11.3f} {ours:6.2f} {min(totals):10.2f}   (mean over flights)")
    return 0 if 0.82 <= pooled <= 0.96 and min(shares.values()) >= 0.75 and ours < min(totals) else 1


if __name__ == "__main__":
    sys.exit(main())
