"""The offset search against its closed form, and its hard cases."""

from __future__ import annotations

import os
from decimal import ROUND_HALF_DOWN, Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.compare.offset import (
    censored_offset,
    difference_moments,
    expected_offset_db,
    grid_offset,
    identifiable_range,
    offset_curve,
    offset_grid,
    pooled_moments,
    read_reference_powers,
    reference_power_dbm,
    trimmed_offset,
)

tenths = st.integers(-2000, 2000).map(lambda k: k / 100)


def pooled_offsets(pairs, per="link"):
    """One offset for all sequences of a group."""
    return pooled_moments({key: difference_moments(*levels) for key, levels in pairs.items()}, per)


def closed_form(difference: np.ndarray) -> float:
    """The mean difference, rounded to tenths (halves towards zero) and clamped, in decimal arithmetic."""
    exact = sum(Decimal(repr(float(d))) for d in difference) / len(difference)
    rounded = exact.quantize(Decimal("0.1"), rounding=ROUND_HALF_DOWN)
    return float(min(max(rounded, Decimal(-50)), Decimal(50)))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(tenths, tenths), min_size=1, max_size=30), st.integers(-60, 60))
def test_grid_search_equals_the_closed_form(pairs, shift):
    measured, simulated = (np.array(side) for side in zip(*pairs, strict=True))
    simulated = simulated + shift
    fit = grid_offset(measured, simulated)
    expected = closed_form(np.round(simulated - measured, 9))
    assert fit.offset_db == expected
    assert fit.at_edge == (abs(expected) == 50.0)
    assert fit.rmse_db == pytest.approx(np.sqrt(np.mean((measured + fit.offset_db - simulated) ** 2)), abs=1e-9)


def test_it_is_the_minimum_of_the_brute_force_search():
    rng = np.random.default_rng(3)
    measured, simulated = rng.normal(-60, 9, 500), rng.normal(-90, 9, 500)
    brute = {k / 10: np.sqrt(np.mean((measured + k / 10 - simulated) ** 2)) for k in range(-500, 501)}
    fit = grid_offset(measured, simulated)
    assert fit.rmse_db == pytest.approx(min(brute.values()), rel=1e-12)
    assert brute[fit.offset_db] == min(brute.values())


@pytest.mark.parametrize(
    ("difference", "offset"), [(0.05, 0.0), (-0.05, 0.0), (0.15, 0.1), (-0.15, -0.1), (0.65, 0.6), (-7.25, -7.2)]
)
def test_a_tie_goes_to_the_offset_nearer_zero(difference, offset):
    assert grid_offset([0.0], [difference]).offset_db == offset


def test_offsets_are_integers_over_ten():
    grid = offset_grid()
    assert len(grid) == 1001
    assert grid.tolist() == [k / 10 for k in range(-500, 501)]
    # a step without a whole inverse, and a span that is no multiple of the step
    assert offset_grid(0.3, (-1.0, 1.0)).tolist() == pytest.approx([-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9])


def test_nan_on_both_sides_and_infinities_do_not_count():
    nan, inf = float("nan"), float("inf")
    fit = grid_offset([-60, nan, -62, nan, -inf], [-50, -51, nan, nan, -50])
    assert (fit.offset_db, fit.n) == (10.0, 1)
    assert fit.rmse_db == pytest.approx(0.0, abs=1e-12)


def test_without_a_pair_there_is_no_number():
    for measured, simulated in (([], []), ([float("nan")] * 3, [1.0, 2.0, 3.0])):
        fit = grid_offset(measured, simulated)
        assert np.isnan(fit.offset_db)
        assert np.isnan(fit.rmse_db)
        assert fit.n == 0
        assert fit.at_edge is False


def test_an_optimum_at_the_edge_is_flagged():
    fit = grid_offset([-130.0, -131.0], [-73.0, -74.0])  # 57 dB, as real Lake Wheeler flights need
    assert fit.offset_db == 50.0
    assert fit.at_edge
    assert grid_offset([-130.0], [-73.0], span_db=(-100, 100)).at_edge is False


def test_sides_of_different_length_are_refused():
    with pytest.raises(ValueError, match="must be pairs"):
        grid_offset([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="step"):
        grid_offset([1.0], [1.0], step_db=0.0)
    with pytest.raises(ValueError, match="no multiple"):
        grid_offset([1.0], [1.0], step_db=10.0, span_db=(1.0, 9.0))


def test_the_curve_has_its_minimum_at_the_fit():
    rng = np.random.default_rng(8)
    measured, simulated = rng.normal(-60, 4, 400), rng.normal(-80, 4, 400)
    offsets, rmse = offset_curve(measured, simulated)
    fit = grid_offset(measured, simulated)
    assert offsets[np.argmin(rmse)] == fit.offset_db
    low, high = identifiable_range(offsets, rmse)
    # RMSE grows by 0.1 dB at sqrt(2 * 0.1 * rmse + 0.01) from the optimum
    assert high - low == pytest.approx(2 * np.sqrt(0.2 * fit.rmse_db + 0.01), abs=0.21)


def test_trimming_ignores_one_tenth_of_rubbish():
    rng = np.random.default_rng(1)
    simulated = rng.normal(-80, 8, 1000)
    measured = simulated - 12.3 + rng.normal(0, 0.01, 1000)
    measured[:90] += 40.0
    assert trimmed_offset(measured, simulated).offset_db == 12.3
    assert trimmed_offset(measured, simulated).n == 900
    assert grid_offset(measured, simulated).offset_db == pytest.approx(12.3 - 3.6, abs=0.1)
    assert trimmed_offset(measured, simulated, keep=1.0).offset_db == grid_offset(measured, simulated).offset_db


def test_trimmed_search_equals_brute_force():
    rng = np.random.default_rng(2)
    measured, simulated = rng.normal(0, 5, 61), rng.normal(3, 5, 61)
    kept = 46
    brute = [np.sqrt(np.mean(np.sort((measured + k / 10 - simulated) ** 2)[:kept])) for k in range(-500, 501)]
    fit = trimmed_offset(measured, simulated, keep=0.75)
    assert fit.n == kept
    assert fit.rmse_db == pytest.approx(min(brute), abs=1e-9)
    assert fit.offset_db == pytest.approx(np.argmin(brute) / 10 - 50, abs=1e-9)


def test_censoring_removes_the_bias_of_a_noise_floor():
    rng = np.random.default_rng(5)
    simulated = rng.uniform(-120, -70, 4000)
    measured = simulated - 10.0 + rng.normal(0, 5, 4000)
    measured[measured < -105] = np.nan  # nothing heard
    missing = grid_offset(measured, simulated).offset_db
    fit = censored_offset(measured, simulated, measured_floor_db=-105.0, simulated_floor_db=-200.0)
    assert fit.offset_db == pytest.approx(10.0, abs=0.3)
    assert fit.sigma_db == pytest.approx(5.0, abs=0.2)
    assert abs(missing - 10.0) > 0.5  # dropping them is what the variant is there to mend
    assert fit.n_measured_below == np.isnan(measured).sum()
    assert fit.n + fit.n_measured_below == 4000


def test_censoring_without_censored_samples_is_the_grid_search():
    rng = np.random.default_rng(6)
    measured, simulated = rng.normal(-60, 3, 300), rng.normal(-50, 3, 300)
    fit = censored_offset(measured, simulated, measured_floor_db=-200, simulated_floor_db=-200)
    plain = grid_offset(measured, simulated)
    assert fit.offset_db == plain.offset_db
    assert fit.sigma_db == pytest.approx(np.std(simulated - measured), rel=1e-4)


def test_no_path_counts_as_below_the_simulated_floor():
    # measured levels without a path say that the path is weak: they pull the offset down, as a full sample would
    simulated = np.array([-80.0, -82.0, -78.0, np.nan, np.nan])
    measured = np.array([-85.0, -88.0, -82.0, -90.0, -91.0])
    free = censored_offset(measured, simulated, measured_floor_db=-200, simulated_floor_db=-60.0 - 200)
    held = censored_offset(measured, simulated, measured_floor_db=-200, simulated_floor_db=-88.0)
    assert free.n_simulated_below == held.n_simulated_below == 2
    assert held.offset_db < grid_offset(measured, simulated).offset_db
    both = censored_offset([np.nan], [np.nan], measured_floor_db=-100, simulated_floor_db=-100)
    assert both.n_both_below == 1
    assert np.isnan(both.offset_db)


def test_offsets_can_be_shared():
    pairs = {
        ("f1", "LW1", "USRP1"): ([0.0, 0.0], [2.0, 2.0]),
        ("f1", "LW1", "USRP2"): ([0.0], [8.0]),
        ("f2", "LW1", "USRP1"): ([0.0], [5.0]),
    }
    assert [f.offset_db for f in pooled_offsets(pairs).values()] == [2.0, 8.0, 5.0]
    assert [f.offset_db for f in pooled_offsets(pairs, "channel").values()] == [3.0, 8.0, 3.0]
    assert [f.offset_db for f in pooled_offsets(pairs, "flight").values()] == [4.0, 4.0, 5.0]
    shared = pooled_offsets(pairs, "all")
    # 17 / 4 = 4.25, a tie, goes to 4.2
    assert {f.offset_db for f in shared.values()} == {4.2}
    assert shared["f1", "LW1", "USRP2"].rmse_db == pytest.approx(3.8)


REFERENCES = """Node,Category,Channel,PA_Enabled,Gain,Freq_3.30GHz,Freq_3.40GHz
lw1,tx,ch0,0,60.0,-2.0,-1.0
lw1,rx,ch0,1,30.0,-40.0,
lw1,rx,ch0,0,30.0,-10.0,-12.0
"""


def test_reference_powers_give_the_expected_offset(tmp_path):
    path = tmp_path / "refs.csv"
    path.write_text(REFERENCES.replace("lw1,rx,ch0,1", "\nlw1,rx,ch0,1"))  # an empty line is passed over
    table = read_reference_powers(path)
    assert len(table) == 3
    level = reference_power_dbm(table, node="LW1", category="rx", channel="ch0", gain_db=30.2, frequency_hz=3.35e9)
    assert level == pytest.approx(-11.0)
    amplified = reference_power_dbm(
        table, node="LW1", category="rx", channel="ch0", gain_db=30, frequency_hz=3.4e9, amplifier=True
    )
    assert np.isnan(amplified)  # that cell is empty
    assert np.isnan(
        reference_power_dbm(table, node="LW9", category="rx", channel="ch0", gain_db=30, frequency_hz=3.4e9)
    )
    # full scale reads -11 dBm; sent with 2 dBm; simulated with unit power (30 dBm for 1 W, path gain 0 dBm)
    offset = expected_offset_db(receiver_reference_dbm=level, transmitter_reference_dbm=2.0, simulated_transmit_dbm=0.0)
    path_gain = -90.0
    reading = path_gain + 2.0 - level
    assert reading + offset == pytest.approx(path_gain)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "no table of reference powers"),
        (REFERENCES + "lw1,rx,ch0,0,x,-1,-1\n", "line 5: unreadable row"),
        (REFERENCES + "lw1,rx,ch0,0,1.0,-1\n", "line 5: unreadable row"),
        (REFERENCES.replace("3.30", "x"), "unreadable carrier"),
    ],
)
def test_a_broken_reference_table_is_named(tmp_path, text, message):
    path = tmp_path / "refs.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_reference_powers(path)
    with pytest.raises(InputError, match="cannot read"):
        read_reference_powers(tmp_path / "missing.csv")


@pytest.mark.field
def test_the_real_reference_table_reads():
    folder = os.environ.get("AERPAW_CMP_FIELD_DATA")
    if not folder:
        pytest.skip("AERPAW_CMP_FIELD_DATA is not set")
    table = read_reference_powers(Path(folder) / "antennas" / "usrp_power_refs.csv")
    assert len(table) == 5194
    high, low = (
        reference_power_dbm(table, node="lw1", category="rx", channel="ch0", gain_db=g, frequency_hz=3.3e9)
        for g in (10, 40)
    )
    assert high - low == pytest.approx(30.0, abs=2.0)  # 30 dB more gain: full scale 30 dB lower


@pytest.mark.parametrize("level", [1e30, -1e30, 1e18, -1e17, 1e308, -1e308, 60.0, -60.0, 50.0, 49.96])
def test_the_edge_of_the_span_is_told_for_any_input(level: float) -> None:
    fit = grid_offset([0.0, 0.0], [level, level])
    assert fit.at_edge
    assert fit.offset_db == np.sign(level) * 50.0
    mixed = grid_offset([0.0, 0.0, 0.0], [level, 1.0, 1.0])
    assert mixed.at_edge == (abs(level) / 3 > 50)


def test_inside_the_span_is_not_its_edge() -> None:
    assert not grid_offset([0.0], [49.9]).at_edge
    assert not grid_offset([0.0, 0.0], [1e308, -1e308]).at_edge


def test_a_grid_that_fits_in_no_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="2e\\+16 offsets to try"):
        offset_grid(1e-7, (-1e9, 1e9))


@pytest.mark.parametrize("path_loss_db", [60.0, 95.5])
def test_the_expected_offset_closes_a_link_budget(path_loss_db: float) -> None:
    """A signal followed by hand through amplifiers and cables to the reading; the offset brings it to the simulation."""
    full_scale_out_dbm, backoff_db, amplifier_db = 12.0, -4.0, 17.0  # transmitter: reference, digital level, PA
    full_scale_in_dbm, cable_db = -35.0, -2.5  # receiver: what reads 0 dBFS at the port; a cable in front of it
    at_antenna_dbm = full_scale_out_dbm + backoff_db + amplifier_db - path_loss_db
    reading_db = at_antenna_dbm + cable_db - full_scale_in_dbm
    simulated_dbm = 40.0 - path_loss_db
    offset = expected_offset_db(
        receiver_reference_dbm=full_scale_in_dbm,
        transmitter_reference_dbm=full_scale_out_dbm,
        simulated_transmit_dbm=40.0,
        transmit_amplitude_dbfs=backoff_db,
        transmit_gain_db=amplifier_db,
        receive_gain_db=cable_db,
    )
    assert reading_db + offset == pytest.approx(simulated_dbm)
