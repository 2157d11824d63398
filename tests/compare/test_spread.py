"""The error bars of a learned prediction have the stated coverage."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import norm

from aerpaw_cmp.compare.gains import (
    NO_SPREAD,
    SHARES,
    LinkSamples,
    LostLock,
    Spread,
    StatedSpread,
    fading_of,
    inside_shares,
)

N = 60_000


def samples(level_db: np.ndarray) -> LinkSamples:
    unit = np.tile([1.0, 0.0, 0.0], (len(level_db), 1))
    return LinkSamples(
        flight="a", tower="LW1", channel="A", time_s=0.1 * np.arange(len(level_db)), position_m=100.0 * unit,
        at_uav=unit, at_tower=unit, residual_db=level_db,
    )  # fmt: skip


@pytest.mark.parametrize(("freedom", "kurtosis"), [(np.inf, 0.0), (8.0, 1.5)])
def test_fading_is_what_is_left_within_the_mean(freedom: float, kurtosis: float) -> None:
    """Planted: 2.5 dB of normal or of heavy-tailed fading on a level that moves by 10 dB from bin to bin."""
    random = np.random.default_rng(3)
    fading = random.normal(size=N) if np.isinf(freedom) else random.standard_t(freedom, N)
    slow = np.repeat(random.normal(0.0, 10.0, N // 40), 40)
    sd, excess = fading_of([samples(slow + 2.5 * fading / fading.std())], 4.0)
    assert sd == pytest.approx(2.5, rel=0.01)
    assert excess == pytest.approx(kurtosis, abs=0.25)
    unmeasured = np.full(N, np.nan)
    assert fading_of([samples(unmeasured)], 4.0) == (0.0, 0.0)


@pytest.mark.parametrize("gone_db", [0.0, 3.0, 12.0])
@pytest.mark.parametrize("direct", [0.0, 3.0, np.inf])
def test_intervals_hold_their_share_where_paths_fade(direct: float, gone_db: float) -> None:
    """Nuisance, noise and gain normal, fading of Rice's law in dB (direct power by scattered): 50, 90, 95 % hold.

    Within 2.5 points, from fading alone (Rayleigh's 5.6 dB) to fading that hardly matters.
    """
    random = np.random.default_rng(4)
    scattered = np.array([1.0, 1j]) @ random.normal(0.0, np.sqrt(0.5), (2, N))
    wave = scattered + np.sqrt(direct) if np.isfinite(direct) else np.exp(0.2 * random.normal(size=N))
    fading = 20.0 * np.log10(np.abs(wave))
    fading -= fading.mean()
    kurtosis = float(np.mean(fading**4) / np.mean(fading**2) ** 2 - 3.0)
    sd = float(fading.std())
    gain = gone_db * random.uniform(0.1, 0.5, N)
    own, noise = 0.5 * gone_db, 0.3 * gone_db
    error = random.normal(size=N) * np.sqrt(gain**2 + own**2 + noise**2) + fading
    spread = Spread(own_sd_db=own, noise_sd_db=noise, fading_sd_db=sd, fading_kurtosis=kurtosis, bin_s=4.0)
    held = inside_shares(error, StatedSpread(gain_sd_db=gain, spread=spread))
    for share in SHARES:
        assert held[f"inside_{100 * share:.0f}"] == pytest.approx(share, abs=0.025)
    assert error.std() == pytest.approx(float(np.sqrt(np.mean(spread.total_db(gain) ** 2))), rel=0.02)


def test_two_parts_hold_their_share_and_their_score_is_the_integral_over_levels() -> None:
    """Levels in lock lie about the prediction, others 20 dB below and less: no normal distribution holds both."""
    random = np.random.default_rng(7)
    probability, lost_db = random.uniform(0.0, 1.0, N), random.uniform(-25.0, -15.0, N)
    locked = random.random(N) < probability
    error = np.where(locked, random.normal(1.0, 3.0, N), random.normal(lost_db, 6.0))
    lock = LostLock(probability=probability, locked_db=np.ones(N), lost_db=lost_db, locked_sd_db=3.0, lost_sd_db=6.0)
    stated = StatedSpread(gain_sd_db=np.ones(N), spread=NO_SPREAD, lock=lock)
    for share, held in zip(SHARES, inside_shares(error, stated).values(), strict=True):
        assert held == pytest.approx(share, abs=0.015)
    for about_db in (0.0, -4.0):
        assert lock.sd_db(np.full(N, about_db))[:N].mean() == pytest.approx(
            np.mean(np.sqrt(probability * ((1 - about_db) ** 2 + 9) + (1 - probability) * ((lost_db - about_db) ** 2 + 36)))
        )  # fmt: skip
        assert np.mean(lock.sd_db(np.full(N, about_db)) ** 2) == pytest.approx(
            np.mean((error - about_db) ** 2), rel=0.02
        )
    grid = np.linspace(-80.0, 60.0, 7001)
    for first in range(3):
        part = {name: getattr(lock, name)[first : first + 1] for name in ("probability", "locked_db", "lost_db")}
        alone = StatedSpread(gain_sd_db=np.ones(1), spread=NO_SPREAD, lock=dataclasses.replace(lock, **part))
        below = probability[first] * norm.cdf(grid, 1.0, 3.0) + (1 - probability[first]) * norm.cdf(
            grid, lost_db[first], 6.0
        )
        score = 0.02 * ((below - (grid > error[first])) ** 2).sum()
        assert alone.crps_db(error[first : first + 1]) == pytest.approx(score, abs=0.02)
    spread = Spread(own_sd_db=3.0, noise_sd_db=4.0, fading_sd_db=0.0, fading_kurtosis=0.0, bin_s=4.0)
    normal = StatedSpread(gain_sd_db=np.array([0.0, np.nan]), spread=spread)
    assert normal.crps_db(np.array([0.0, 2.0])) == pytest.approx(5.0 * (np.sqrt(2.0) - 1.0) / np.sqrt(np.pi))
    assert np.isnan(normal.crps_db(np.array([np.nan, 2.0])))


def test_fading_does_not_depend_on_the_zero_of_the_clock() -> None:
    """Bins begin with the first sample, for any origin of time."""
    random = np.random.default_rng(8)
    flown = samples(random.normal(0.0, 3.0, 800) + np.repeat(random.normal(0.0, 8.0, 100), 8))
    flown = dataclasses.replace(
        flown, time_s=np.arange(800) / 8.0
    )  # exact in binary: no sample changes its bin by rounding
    expected = fading_of([flown], 1.0)
    for shift_s in (0.375, 17.5, 1024.25):
        assert fading_of([dataclasses.replace(flown, time_s=flown.time_s + shift_s)], 1.0) == pytest.approx(expected)


def test_the_kurtosis_counts_only_as_far_as_the_expansion_holds() -> None:
    """Up to an excess kurtosis of 2 either way, and no further."""
    none = np.zeros(1)

    def width(kurtosis: float) -> float:
        spread = Spread(own_sd_db=0.0, noise_sd_db=0.0, fading_sd_db=4.0, fading_kurtosis=kurtosis, bin_s=4.0)
        return float(spread.half_width_db(none, 0.95)[0])

    assert width(0.0) == pytest.approx(4.0 * 1.95996, rel=1e-4)
    for share, z in ((0.5, 0.67449), (0.9, 1.644854)):  # Cornish and Fisher (1938), skewness by 0.54 of the kurtosis
        spread = Spread(own_sd_db=3.0, noise_sd_db=0.0, fading_sd_db=4.0, fading_kurtosis=1.5, bin_s=4.0)
        k, skew2 = 1.5 * 0.8**4, 0.54 * 1.5 * 0.8**6
        expected = 5.0 * (z + (z**3 - 3 * z) * k / 24 + (z**5 - 10 * z**3 + 15 * z) * skew2 / 72)
        assert spread.half_width_db(none, share)[0] == pytest.approx(expected, rel=1e-4)
    columns = StatedSpread(gain_sd_db=np.array([0.0, np.nan]), spread=spread).columns(np.array([-70.0, -60.0]))
    assert (columns["simulated_low_dbm"][0], columns["simulated_high_dbm"][0]) == pytest.approx(
        (-70.0 - expected, -70.0 + expected), rel=1e-5
    )
    for name, value in (("simulated_sd_db", 5.0), ("own_sd_db", 3.0), ("noise_sd_db", 0.0), ("fading_sd_db", 4.0)):
        assert columns[name][0] == value
        assert np.isnan(columns[name][1])
    assert width(1.0) != width(1.9) != width(2.0) == width(3.0) == width(50.0)
    assert width(-2.0) == width(-9.0) < width(0.0)


def test_fading_is_the_pooled_variance_about_the_means_of_bins() -> None:
    """Bins may have any size of two samples or more. A single sample has no estimate."""
    random = np.random.default_rng(9)
    bins = [random.normal(10.0 * k, 1.0 + k, size) for k, size in enumerate((2, 3, 2, 7, 1, 2))]
    time_s = np.concatenate([4.0 * k + np.linspace(0.5, 3.5, len(part)) for k, part in enumerate(bins)])
    flown = dataclasses.replace(samples(np.concatenate(bins)), time_s=time_s)
    several = [part for part in bins if len(part) > 1]
    pooled = sum(len(part) * part.var(ddof=1) for part in several) / sum(map(len, several))
    fading = fading_of([samples(np.full(3, np.nan)), flown, samples(np.zeros(1))], 4.0)
    assert fading[0] == pytest.approx(np.sqrt(pooled), rel=1e-12)
    away = np.concatenate([(part - part.mean()) * np.sqrt(len(part) / (len(part) - 1)) for part in several])
    assert fading[1] == pytest.approx(np.mean(away**4) / pooled**2 - 3.0, rel=1e-12)
