"""The likely cause of an error: named where it was planted, silent where nothing was."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.stats import multivariate_normal

from aerpaw_cmp.compare.judge import causes
from aerpaw_cmp.compare.judge.causes import LevelEvidence, likely_cause
from benchmarks.planted_causes import TROUBLES, flight


def test_each_planted_trouble_is_named_and_a_sound_flight_is_left_alone() -> None:
    """Four flights of each kind: at most two of the 28 troubled ones are misnamed, no sound flight is accused."""
    wrong = []
    for number in range(4 * len(TROUBLES)):
        trouble = TROUBLES[number % len(TROUBLES)]
        named = likely_cause(flight(trouble, np.random.default_rng([11, number]))).name
        wrong += [(trouble, named)] if named != trouble else []
    assert len(wrong) <= 2, wrong
    assert "none" not in [planted for planted, _ in wrong]


def _evidence(seed: int = 3) -> LevelEvidence:
    return flight("none", np.random.default_rng([5, seed]))


@pytest.mark.parametrize("lag_s", [-4.0, 3.0, 6.0])
def test_a_clock_comes_back_with_its_sign_and_interval(lag_s: float) -> None:
    """The radio's clock shows later times by the lag: its samples show what was lag seconds ago."""
    sound = _evidence()
    late = np.interp(sound.time_s - lag_s, sound.time_s, sound.predicted_db)
    noise = sound.measured_db - sound.predicted_db
    cause = likely_cause(replace(sound, measured_db=late + noise))
    assert cause.name == "clock"
    assert cause.estimate == pytest.approx(lag_s, abs=1.0)
    assert cause.ci95[0] < cause.estimate < cause.ci95[1]  # never narrower than the steps that were tried
    confirmed = likely_cause(replace(sound, measured_db=late + noise, clock_confirmed=True))
    assert confirmed.name != "clock"


@pytest.mark.parametrize("step_db", [-7.0, 7.0])
def test_a_gain_step_comes_back_with_instant_size_and_interval(step_db: float) -> None:
    sound = _evidence()
    at = sound.time_s[len(sound.time_s) // 3]
    cause = likely_cause(replace(sound, measured_db=sound.measured_db + step_db * (sound.time_s > at)))
    assert cause.name == "gain step"
    assert float(cause.where) == pytest.approx(at, abs=3.0)
    assert cause.ci95[0] < step_db < cause.ci95[1]
    assert cause.rmse_with_db < cause.rmse_db


def test_slow_fading_alone_is_no_step_and_no_loss() -> None:
    """A first-order process of 4 dB over 20 s wanders as far as a step does."""
    generator = np.random.default_rng(8)
    accused = 0
    for seed in range(20):
        sound = _evidence(seed)
        n, keep = len(sound.time_s), np.exp(-0.1 / 20.0)
        white, walk = generator.standard_normal(n) * 4.0 * np.sqrt(1 - keep**2), np.zeros(n)
        for i in range(1, n):
            walk[i] = keep * walk[i - 1] + white[i]
        accused += likely_cause(replace(sound, measured_db=sound.predicted_db + walk - 40.0)).name != "none"
    assert accused <= 2


def test_too_few_samples_and_no_samples_accuse_nobody() -> None:
    sound = _evidence()
    silent = replace(sound, measured_db=np.full(len(sound.time_s), np.nan))
    assert likely_cause(silent).name == "none"
    short = np.arange(len(sound.time_s)) < 400  # 40 s
    assert likely_cause(replace(sound, measured_db=np.where(short, sound.measured_db + 9.0, np.nan))).name == "none"


def _direction(degrees: np.ndarray) -> np.ndarray:
    return degrees % 360.0


def test_a_blocked_sector_comes_back_with_its_ends_and_loss() -> None:
    sound = _evidence()
    first = np.median(sound.tower_azimuth_deg) - 20.0
    inside = (sound.tower_azimuth_deg - first) % 360.0 < 40.0
    cause = likely_cause(replace(sound, measured_db=sound.measured_db - 12.0 * inside))
    assert cause.name == "blocked"
    assert cause.ci95[0] < cause.estimate < cause.ci95[1]
    assert cause.estimate == pytest.approx(12.0, abs=2.0)
    ends = [float(text) for text in cause.where.split(" to ")]
    assert [_direction(end - start + 180.0) for end, start in zip(ends, (first, first + 40.0), strict=True)] == (
        pytest.approx([180.0, 180.0], abs=8.0)
    )
    assert all(0.0 <= end < 360.0 for end in ends)


def test_a_turned_antenna_another_tower_and_a_floor_come_back_as_planted() -> None:
    sound = _evidence()
    noise = sound.measured_db - sound.predicted_db
    turned = likely_cause(replace(sound, measured_db=sound.measured_db + sound.turned_db[90.0]))
    assert (turned.name, turned.estimate) == ("heading", pytest.approx(90.0, abs=10.0))
    assert turned.ci95[0] < turned.estimate < turned.ci95[1]
    swapped = likely_cause(replace(sound, measured_db=sound.other_towers_db["LW3"] + noise))
    assert (swapped.name, swapped.where) == ("tower", "LW3")
    floor = float(np.quantile(sound.measured_db, 0.4))
    shown = np.maximum(sound.measured_db, floor) + np.random.default_rng(1).normal(0.0, 0.3, len(noise))
    lost = likely_cause(replace(sound, measured_db=shown))
    assert (lost.name, lost.estimate) == ("floor", pytest.approx(floor, abs=1.0))
    for cause in (turned, swapped, lost):
        assert cause.gain > 4.0
        assert cause.rmse_with_db < 0.9 * cause.rmse_db


def _residual(n: int = 80) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(4)
    return np.cumsum(generator.normal(size=n)) + 3.0, generator.normal(size=(n, 2))


@pytest.mark.parametrize("columns", [False, True])
def test_the_fit_is_the_best_normal_with_the_covariance_of_its_memory(columns: bool) -> None:
    """Dense covariances phi^|i - j|, offset and coefficients by generalised least squares, the variance its own mean."""
    residual, extra = _residual()
    n = len(residual)
    design = np.column_stack([np.ones(n), extra]) if columns else np.ones((n, 1))
    best = (-np.inf, residual)
    for phi in (0.0, 0.3, 0.5, 0.7, 0.8, 0.87, 0.92, 0.95, 0.97, 0.985, 0.995):
        cover = phi ** np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / (1.0 - phi**2)
        inverse = np.linalg.inv(cover)
        coefficients = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ residual)
        left = residual - design @ coefficients
        variance = left @ inverse @ left / n
        best = max(
            best, (multivariate_normal.logpdf(left, None, variance * cover), left), key=lambda candidate: candidate[0]
        )
    fit = causes._fitted(residual, extra if columns else None)
    assert fit.log_likelihood == pytest.approx(best[0] + 0.5 * n * (np.log(2.0 * np.pi) + 1.0), abs=1e-6)
    np.testing.assert_allclose(fit.residual_db, best[1] - best[1].mean(), atol=1e-6)


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_shifts_are_those_of_least_squares_on_whitened_samples_with_an_offset(phi: float) -> None:
    residual, _ = _residual()
    masks = np.array([np.arange(80) >= 30, np.arange(80) % 7 < 3, np.zeros(80, dtype=bool)])
    shift, taken = causes._shift(residual, masks, phi)
    y = residual[1:] - phi * residual[:-1]
    for k, mask in enumerate(masks[:2]):
        design = np.column_stack([np.ones(79), mask[1:] - phi * mask[:-1]])
        fit = lsq_linear(design, y)
        assert shift[k] == pytest.approx(fit.x[1])
        assert taken[k] == pytest.approx(np.square(y - y.mean()).sum() - 2.0 * fit.cost)
        error = np.sqrt(2.0 * fit.cost / 79 * np.linalg.inv(design.T @ design)[1, 1])
        assert causes._bounded(residual, mask, fit.x[1], phi) == pytest.approx(
            (fit.x[1], fit.x[1] - 1.96 * error, fit.x[1] + 1.96 * error)
        )
    assert (shift[2], taken[2]) == (0.0, 0.0)


def test_a_second_is_the_mean_of_its_samples_and_directions_turn_the_short_way() -> None:
    time = np.arange(0.0, 90.0, 0.25)
    level = np.sin(time)
    level[5] = np.nan
    around = 180.0 + 20.0 * np.cos(5.0 * time)  # on both sides of where angles jump
    evidence = replace(
        _evidence(), time_s=time, measured_db=level, predicted_db=0.5 * time, uav_azimuth_deg=around,
        uav_elevation_deg=time, tower_azimuth_deg=around - 180.0, turned_db={10.0: level + 1.0}, other_towers_db={"B": -time},
    )  # fmt: skip
    seconds = causes._binned(evidence)
    assert seconds is not None
    for second in range(90):
        some = [k for k in range(len(time)) if second <= time[k] < second + 1 and np.isfinite(level[k])]
        assert seconds.measured_db[second] == pytest.approx(np.mean(level[some]))
        assert seconds.predicted_db[second] == pytest.approx(np.mean(0.5 * time[some]))
        assert seconds.other_towers_db["B"][second] == pytest.approx(-np.mean(time[some]))
        assert _direction(seconds.uav_azimuth_deg[second]) == pytest.approx(np.mean(around[some]), abs=0.2)
        assert seconds.tower_azimuth_deg[second] == pytest.approx(np.mean(around[some]) - 180.0, abs=0.2)
    few = replace(evidence, measured_db=np.where(time < 59, level, np.nan))
    enough = replace(evidence, measured_db=np.where(time < 60, level, np.nan))
    assert causes._binned(few) is None
    assert causes._binned(enough) is not None


def test_a_range_reaches_half_way_to_the_values_that_are_less_likely() -> None:
    """Within half of chi-squared's 95 % point, 1.92, a value is as good as the best; at the end of the scale it ends there."""
    heights = {0.0: -9.0, 1.0: -1.9, 2.0: 0.0, 4.0: -1.5, 8.0: -2.0}
    fits = {value: causes._Fit(height, np.zeros(3)) for value, height in heights.items()}
    assert causes._profiled("lag", fits)[:3] == ("lag", (2.0, 0.5, 6.0), "")
    del fits[0.0], fits[8.0]
    assert causes._profiled("lag", fits)[1] == (2.0, 1.0, 4.0)


def test_above_a_floor_the_offset_is_that_of_the_samples_above_it() -> None:
    """Planted: predicted levels 10 dB too high, a floor at -90 dB, and a spread of its own on either side."""
    generator = np.random.default_rng(6)
    sound = causes._binned(_evidence())
    assert sound is not None
    predicted = np.linspace(-100.0, -60.0, len(sound.time_s)) + generator.normal(0, 4, len(sound.time_s))
    above = predicted - 10.0 > -90.0
    noise = generator.normal(0.0, np.where(above, 2.0, 0.5))
    planted = replace(sound, predicted_db=predicted, measured_db=np.maximum(predicted - 10.0, -90.0) + noise)
    fit = causes._above_floor(planted, -90.0)
    np.testing.assert_allclose(fit.residual_db, noise - noise[above].mean() * above, atol=0.25)
    above = planted.measured_db - fit.residual_db > -90.0 + 1e-9
    spread = np.where(above, fit.residual_db[above].std(), fit.residual_db[~above].std())
    expected = causes._fitted(fit.residual_db / spread).log_likelihood - np.log(spread).sum()
    assert fit.log_likelihood == pytest.approx(expected)
    assert causes._above_floor(planted, -40.0).log_likelihood == -np.inf, "nothing lies above"
    assert causes._above_floor(planted, -85.0).log_likelihood == -np.inf, "levels lie far below"
    assert causes._floored(planted)[1][0] == pytest.approx(-90.0, abs=1.0)


def test_harmonics_are_two_of_the_azimuth_and_two_powers_of_the_elevation() -> None:
    sound = causes._binned(_evidence())
    assert sound is not None
    around, up = np.radians(sound.uav_azimuth_deg), np.radians(sound.uav_elevation_deg)
    columns = causes._harmonics(sound)
    assert np.abs(columns.mean(axis=0)).max() < 1e-12
    for law in (
        np.cos(around - 1.0),
        np.sin(around) * np.cos(around),
        np.cos(2.0 * around),
        np.sin(up),
        np.cos(up) ** 2,
    ):
        rest = np.linalg.lstsq(np.column_stack([columns, np.ones(len(up))]), law, rcond=None)[1]
        assert rest == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("gain", "left", "named"), [(4.01, 0.89, True), (3.99, 0.5, False), (4.01, 0.91, False), (50.0, 0.89, True)]
)
def test_a_cause_gains_four_beyond_its_cost_and_takes_a_tenth_of_the_error(
    gain: float, left: float, named: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two quantities cost the logarithm of the seconds; a cause that gains less stands behind."""
    sound = causes._binned(_evidence())
    assert sound is not None
    plain = causes._fitted(sound.measured_db - sound.predicted_db)
    best, other = (
        causes._Fit(plain.log_likelihood + more + np.log(len(sound.time_s)), left * plain.residual_db)
        for more in (gain, gain - 1.0)
    )
    nothing = (np.nan, np.nan, np.nan)
    troubles = [(2.0, "made", (2.0, 1.0, 4.0), "here", best), (2.0, "second", nothing, "", other)]
    monkeypatch.setattr(causes, "_troubles", lambda _: iter(troubles))
    cause = likely_cause(_evidence())
    assert cause.name == ("made" if named else "none")
    if named:
        rmse = np.sqrt(np.mean(plain.residual_db**2))
        assert (cause.estimate, cause.ci95, cause.where) == (2.0, (1.0, 4.0), "here")
        assert (cause.rmse_db, cause.rmse_with_db, cause.gain) == pytest.approx((rmse, left * rmse, gain))


def test_every_trouble_has_its_cost_and_is_the_best_of_what_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """By loops: each shift, heading, tower, floor, sector and step is fitted, the likeliest stands."""
    sound = causes._binned(_evidence())
    assert sound is not None
    residual, fitted = sound.measured_db - sound.predicted_db, causes._fitted
    troubles = {(cost, name): rest for cost, name, *rest in causes._troubles(sound)}
    names = ("clock", "heading", "pattern", "tower", "pattern", "blocked", "floor", "gain step")
    assert list(troubles) == list(zip((1, 1, 4, 1, 3, 3, 2, 2), names, strict=True))
    assert [name for _, name, *_ in causes._troubles(replace(sound, clock_confirmed=True))] == list(names[1:])
    bare = replace(sound, turned_db={}, other_towers_db={})
    assert [name for _, name, *_ in causes._troubles(bare)] == ["clock", "pattern", "blocked", "floor", "gain step"]
    lags = {
        lag / 2: fitted(sound.measured_db - np.interp(sound.time_s - lag / 2, sound.time_s, sound.predicted_db))
        for lag in range(-20, 21) if abs(lag) > 1
    }  # fmt: skip
    turns = {angle: fitted(residual - turn) for angle, turn in sound.turned_db.items()}
    for name, fits in (("clock", lags), ("heading", turns)):
        _, estimate, _, fit = causes._profiled(name, fits)
        assert troubles[1.0, name][0] == estimate
        assert troubles[1.0, name][2].log_likelihood == fit.log_likelihood
    turned = fitted(residual - sound.turned_db[troubles[1.0, "heading"][0][0]], causes._harmonics(sound))
    assert troubles[4.0, "pattern"][2].log_likelihood == turned.log_likelihood
    assert troubles[3.0, "pattern"][2].log_likelihood == fitted(residual, causes._harmonics(sound)).log_likelihood
    towers = {name: fitted(sound.measured_db - level).log_likelihood for name, level in sound.other_towers_db.items()}
    assert troubles[1.0, "tower"][1] == max(towers, key=towers.__getitem__)
    assert troubles[1.0, "tower"][2].log_likelihood == max(towers.values())
    tried: list[float] = []
    monkeypatch.setattr(causes, "_above_floor", lambda _, floor: tried.append(floor) or fitted(residual))
    causes._floored(sound)
    assert tried == pytest.approx(np.quantile(sound.measured_db, 0.02 * np.arange(1, 36)))

    def shifted(mask: np.ndarray, phi: float) -> tuple[float, float]:
        shift, taken = causes._shift(residual, mask[None], phi)
        return float(shift[0]), float(taken[0])

    sectors, steps = [], []
    for phi in (0.5, 0.8, 0.95):
        tries = [(5.0 * k, width) for width in (10, 15, 20, 30, 45, 60, 90) for k in range(72)]
        for _ in range(2):
            scores = []
            for first, width in tries:
                mask = (sound.tower_azimuth_deg - first) % 360.0 < width
                shift, taken = shifted(mask, phi)
                allowed = min(mask.sum(), (~mask).sum()) >= 5 and shift < 0.0
                scores.append((taken if allowed else -1.0, -len(scores), first, width))
            *_, first, width = max(scores)
            tries = [(first + i, max(width + j, 2.0)) for i in range(-6, 7) for j in range(-8, 9)]
        mask = (sound.tower_azimuth_deg - first) % 360.0 < width
        bounds = causes._bounded(residual, mask, shifted(mask, phi)[0], phi)
        sectors.append((fitted(residual, 1.0 * mask[:, None]).log_likelihood, (-bounds[0], -bounds[2], -bounds[1])))
        starts = np.arange(10, len(residual) - 10)
        assert len(starts) < 600
        at = max(starts, key=lambda start: shifted(np.arange(len(residual)) >= start, phi)[1])
        mask = np.arange(len(residual)) >= at
        bounds = causes._bounded(residual, mask, shifted(mask, phi)[0], phi)
        steps.append((fitted(residual, 1.0 * mask[:, None]).log_likelihood, bounds, f"{sound.time_s[at]:.0f}"))
    likelihood, bounds = max(sectors, key=lambda fit_of: fit_of[0])  # of equals, that of the shortest memory
    assert troubles[3.0, "blocked"][0] == pytest.approx(bounds)
    assert troubles[3.0, "blocked"][2].log_likelihood == pytest.approx(likelihood)
    likelihood, bounds, where = max(steps, key=lambda fit_of: fit_of[0])
    assert troubles[2.0, "gain step"][0] == pytest.approx(bounds)
    assert (troubles[2.0, "gain step"][1], troubles[2.0, "gain step"][2].log_likelihood) == (
        where,
        pytest.approx(likelihood),
    )
