"""Hard flights through reading, replay and comparison: no number where there is none, no exception, no silence."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.common.units import noise_floor_dbm
from aerpaw_cmp.compare.gains import NO_SPREAD, StatedSpread
from aerpaw_cmp.compare.result import Cause, RssResult
from aerpaw_cmp.flight.data import FlightData, load_data
from aerpaw_cmp.flight.gains import foliage_notes
from aerpaw_cmp.flight.replay import replay_rank, replay_rss
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs import compare_flight, likely_cause
from aerpaw_cmp.jobs.compare_flight import compare_rank_series, compare_rss_series, pairs_of
from aerpaw_cmp.jobs.flight_run import run_flight
from aerpaw_cmp.propagation.geometry import rotation_from_aircraft
from aerpaw_cmp.report.flight_data import rank_warnings, rss_warnings, track_of
from aerpaw_cmp.report.flight_words import instants
from aerpaw_cmp.site.learned import Errors
from tests.simulated import planned, simulate, write_yaml
from tests.tables import LW1, ORIGIN, POSITIONS, eastwards, rank_log, rss_log, write_csv

pytestmark = pytest.mark.usefixtures("blank_pictures")


def test_a_late_clock_is_the_first_step_where_it_lowers_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sentence, warning and table name the same clock.

    There is no question if the clock was corrected or if it changes nothing. Directions from an estimated position are
    no cause.
    """
    monkeypatch.setattr(likely_cause, "gains_by_direction", lambda *_: None)
    for shifted, other, fall_db, first in (
        (True, None, 0.4, True),
        (True, None, 0.02, False),
        (True, "pattern or blocked", 0.4, True),
        (True, "blocked", 0.4, False),  # the clock test knows gains over directions, but no obstacles
        (True, "lock", 0.4, False),
        (False, None, 0.4, False),
        (True, None, 0.4, None),  # nothing is asked after an error below 1 dB
    ):
        lag = {"in_words": "0.40 s ahead", "radio_minus_telemetry_s": 0.4, "ci95_s": (0.3, 0.5), "verdict": ""}
        of = {
            name: SimpleNamespace(name=f"{name} A", tower=name, antenna="", clock=SimpleNamespace(**clock))
            for name, clock in (("LW1", {"shifted": shifted, **lag}), ("LW2", {"shifted": False, "verdict": "ok"}))
        }
        named = None if other is None else Cause(name=other, sentence="", next_step="")
        monkeypatch.setattr(likely_cause, "flight_cause", lambda _, named=named: named)
        monkeypatch.setattr(likely_cause, "fall_without_lag_db", lambda _, fall_db=fall_db: fall_db)
        monkeypatch.setattr(likely_cause, "_evidence", lambda _, s, *__, of=of, **___: of[s.tower])
        settings = SimpleNamespace(antennas={}, cautions=(), towers={"LW2": SimpleNamespace(region90_m=90.0)})
        data: Any = SimpleNamespace(files=[], rss=[SimpleNamespace(tower=name) for name in of], settings=settings)
        replays: Any = SimpleNamespace(rss=[SimpleNamespace(tower_m=None)] * 2)
        score = SimpleNamespace(rmse_db=0.9 if first is None else 2.0, n=9)
        results: Any = [
            SimpleNamespace(name=f"{name} A", measured_db=np.arange(9.0) * i, training=False, score=score)
            for i, name in enumerate(("LW1", "LW2"), 1)
        ]
        cause, step = likely_cause.cause_of(data, replays, results)
        assert step == (
            "enter the measured position of LW2 in `towers:`" if first is False and other != "lock" else None
        )
        said = "The radio clock at LW1 is 0.40 s ahead; those at LW2 are right."
        assert (cause is not None and (cause.sentence, cause.next_step) == (said, "`rss: {lag: apply}`")) == bool(first)


def test_late_clocks_of_one_computer_have_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(likely_cause, "fall_without_lag_db", lambda _: 0.4)
    names = ("LW1", "LW2", "LW3", "LW4", "LW5")
    wide, verdicts = {"LW4": (0.1, 0.7)}, {"LW3": "ok", "LW5": "cannot tell"}
    lags: Any = [SimpleNamespace(name=f"{at} A", tower=at, clock=SimpleNamespace(
                shifted=at not in verdicts, in_words="0.40 s ahead", radio_minus_telemetry_s=0.4,
                ci95_s=wide.get(at, (0.3, 0.5)), verdict=verdicts.get(at, "shifted")))
                 for at in names]  # fmt: skip
    cause = likely_cause._late_clock(lags)
    assert cause is not None
    # LW4 is ahead, too, but with an interval wider than its lag, and the clock of LW5 is unknown
    assert cause.sentence == "The radio clock at LW1, LW2 is 0.40 s ahead; those at LW3 are right."
    assert cause.channels == ("LW1 A", "LW2 A")


FLOOR_DB = -758.6  # what the sounder writes without a signal


def flight(
    folder: Path, seconds: int = 60, *, rss: dict[str, tuple[Any, Any]] | None = None,
    rank: tuple[Any, Any] | None = None, rt: dict[str, Any] | None = None, rss_keys: dict[str, Any] | None = None,
    **keys: Any,
) -> Path:  # fmt: skip
    """Return a flight eastwards past LW1 at 40 m.

    ``rss`` maps channels to (seconds, levels), and ``rank`` is (seconds, RI).
    """
    t = np.arange(0.0, seconds + 1.0)
    logs = [eastwards(folder, t, 5.0 * (t - 10.0), yaw_deg=120.0)]
    logs += [rss_log(folder, channel, *series) for channel, series in (rss or {}).items()]
    logs += [rank_log(folder, *rank)] if rank is not None else []
    return write_yaml(folder / "flight.yaml", {
        "flight": "hard", "site": {"file": "lake_wheeler", "without_buildings": True}, "timezone": "America/New_York",
        "logs": logs,
        "rt": {"engine": "image", "max_depth": 1, "audit_links": 0, "attitude": "logged", **(rt or {})},
        "rss": {"span_db": [-100, 100], "lag": "off", **(rss_keys or {})}, **keys,
    })  # fmt: skip


def gathered(path: Path) -> FlightData:
    return load_data(load_flight(path), path.parent)


def compared_rss(path: Path) -> list[RssResult]:
    return list(run_flight(gathered(path), audit=False).result.rss)


def free_space_db(at: Any) -> Any:
    """About what is measured at 3.3 GHz, for a plausible course of levels."""
    east = (np.asarray(at, float) - 10) * 5
    return -40.0 - 10 * np.log10(east**2 + 55.0**2 + 30.0**2)


def report_completes(path: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> dict[str, Any]:
    assert main(["report", str(path), "-o", str(path.parent / "out"), "--json"]) == code
    metrics: dict[str, Any] = json.loads(capsys.readouterr().out)
    return metrics


def test_all_out_of_coverage_has_no_numbers_but_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = np.arange(0, 60, 0.5)
    path = flight(tmp_path, rss={"USRP1": (at, np.full(len(at), FLOOR_DB))})
    (series,) = compared_rss(path)
    assert series.score.n == 0
    assert series.score.n_out_of_coverage == len(at)
    assert np.isnan(series.score.rmse_db)
    assert np.isnan(series.score.offset_db)
    assert any("no sample" in text for text in rss_warnings(series))
    channel = report_completes(path, capsys, code=1)["rss"]["LW1"]["USRP1"]  # nothing was compared: no success
    assert channel["rmse_db"] is None
    assert channel["n"] == 0
    assert main(["report", str(path), "-o", str(tmp_path / "out"), "--strict"]) == 1


@pytest.mark.parametrize("levels", [[-70.0], [-70.0, -72.0]])
def test_one_or_two_samples_have_no_error(
    levels: list[float], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An offset fits one sample exactly, and two samples always have a correlation of 1 or -1."""
    path = flight(tmp_path, rss={"USRP1": ([20.0, 25.0][: len(levels)], levels)})
    (series,) = compared_rss(path)
    assert series.score.n == len(levels)
    assert np.isnan([series.score.rmse_db, series.score.correlation, *series.score.rmse_ci95_db]).all()
    channel = report_completes(path, capsys, code=1)["rss"]["LW1"]["USRP1"]
    assert channel["correlation"] is channel["rmse_db"] is channel["baselines"]["free_space"]["rmse_db"] is None
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Nothing could be compared: no channel has 20 samples" in page
    assert f"nothing to score. {len(levels)} of " in page
    assert main(["report", str(path), "-o", str(tmp_path / "again")]) == 1
    assert " with measurement, pose and path; expected 20" in capsys.readouterr().err


def test_one_wild_sample_is_flagged_kept_and_said_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = np.arange(0, 60, 0.5)
    level = free_space_db(at) + np.random.default_rng(3).normal(0, 2, len(at))
    path = flight(tmp_path, rss={"USRP1": (at, np.where(at == 20.0, 99.0, level))})
    channel = report_completes(path, capsys)["rss"]["LW1"]["USRP1"]
    assert (channel["n_outliers"], channel["n"]) == (1, len(at))  # flagged, not dropped
    assert channel["rmse_without_outliers_db"] < 4.0 < 10.0 < channel["rmse_db"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert (
        f"LW1 USRP1: RMSE {channel['rmse_without_outliers_db']:.1f} dB without 1 outlier."
        in page[: page.index("<main>")]
    )


def test_duplicate_and_backward_stamps_give_the_numbers_of_the_sorted_log(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    at = np.round(np.arange(0, 60, 0.25), 3)
    level = free_space_db(at) + rng.normal(0, 2, len(at))
    shuffled = rng.permutation(len(at))
    twice = np.concatenate([shuffled, shuffled[:20]])
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    in_order = np.sort(twice)
    (ordered,) = compared_rss(flight(tmp_path / "a", rss={"USRP1": (at[in_order], level[in_order])}))
    (disordered,) = compared_rss(flight(tmp_path / "b", rss={"USRP1": (at[twice], level[twice])}))
    assert ordered.score.n == disordered.score.n == len(twice)
    assert disordered.score.rmse_db == pytest.approx(ordered.score.rmse_db, abs=1e-9)
    assert disordered.score.offset_db == ordered.score.offset_db
    assert disordered.score.rmse_ci95_db == pytest.approx(ordered.score.rmse_ci95_db, abs=0.2)


def test_levels_below_the_floor_are_counted_not_averaged(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    at = np.arange(0, 60, 0.25)
    level = free_space_db(at) + rng.normal(0, 2, len(at))
    deaf = level < np.quantile(level, 0.3)
    (thinned,) = compared_rss(flight(tmp_path, rss={"USRP1": (at, np.where(deaf, FLOOR_DB, level))}))
    assert thinned.score.n == (~deaf).sum()
    assert thinned.score.n_out_of_coverage == deaf.sum()


def test_an_optimum_at_the_edge_is_an_error_to_look_at(tmp_path: Path) -> None:
    at = np.arange(0, 60, 0.5)
    path = flight(tmp_path, rss={"USRP1": (at, free_space_db(at) + 160)})
    (series,) = compared_rss(path)
    assert series.score.at_edge
    assert any("at the end of its search range" in text for text in rss_warnings(series))


def test_radio_samples_outside_the_telemetry_have_no_pose_and_are_not_out_of_coverage(tmp_path: Path) -> None:
    at = np.arange(40, 80, 0.5)
    (series,) = compared_rss(flight(tmp_path, rss={"USRP1": (at, free_space_db(at))}))
    assert series.further.n_no_pose == (at > 60).sum()
    assert series.score.n == (at <= 60).sum()
    assert series.score.n_out_of_coverage == 0


def test_too_low_samples_are_counted_apart(tmp_path: Path) -> None:
    at = np.arange(0, 60, 0.5)
    (series,) = compared_rss(flight(tmp_path, rss={"USRP1": (at, free_space_db(at))}))
    assert series.further.n_too_low == 0
    (low,) = compared_rss(flight(tmp_path, rss={"USRP1": (at, free_space_db(at))}, rss_keys={"minimum_height_m": 50}))
    assert low.further.n_too_low == len(at)
    assert low.score.n == low.score.n_out_of_coverage == 0


def test_no_csi_is_never_a_rank(tmp_path: Path) -> None:
    at = np.arange(0, 60, 0.5)
    data = gathered(flight(tmp_path, rank=(at, np.zeros(len(at)))))
    (replayed,) = replay_rank(data)
    result = compare_rank_series(data, data.rank[0], replayed)
    assert not np.isfinite(result.measured).any()
    assert any("no rank" in text for text in rank_warnings(result))


def test_two_channels_part_where_one_was_pushed_down(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = np.arange(0, 60, 0.25)
    level = free_space_db(at)
    pushed = np.where((at > 30) & (at < 36), level - 25, level)
    path = flight(tmp_path, rss={"USRP1": (at, level), "USRP2": (at + 0.05, pushed)})
    (pair,) = pairs_of(compared_rss(path))
    assert (pair.first, pair.second) == ("USRP1", "USRP2")
    assert len(pair.time) == len(at)  # 0.05 s is less than half a sampling interval
    (span,) = pair.score.spans
    begin, end = instants(pair.time, span)
    start = np.datetime64(ORIGIN.removesuffix("Z"), "ns")
    assert (begin - start) / np.timedelta64(1, "s") == pytest.approx(30.25, abs=0.6)
    assert (end - start) / np.timedelta64(1, "s") == pytest.approx(35.75, abs=0.6)
    assert span.mean_db > 15
    assert "pairs" in report_completes(path, capsys)


def test_channels_without_common_instants_make_no_pair(tmp_path: Path) -> None:
    early, late = np.arange(0, 20, 0.25), np.arange(30, 60, 0.25)
    path = flight(tmp_path, rss={"USRP1": (early, free_space_db(early)), "USRP2": (late, free_space_db(late))})
    assert pairs_of(compared_rss(path)) == []


def test_the_report_says_where_foliage_models_are_stretched_or_assumed(tmp_path: Path) -> None:
    at = np.arange(0, 10, 0.5)
    series = {"USRP1": (at, free_space_db(at))}

    def notes(*carriers_hz: float, **rt: Any) -> str:
        data = gathered(flight(tmp_path, 20, rss=series, rt=rt))
        return " ".join(foliage_notes(data.site.wooded, data.settings.rt, carriers_hz))

    attenuating = {"foliage": "attenuating"}
    assert notes(3.4e9) == notes(3.4e9, foliage="opaque") == notes(2.0e9, **attenuating) == ""
    assert notes(3.4e9, **attenuating, advanced={"gamma_db_per_m": 0.6, "maximum_loss_db": 40}) == ""
    stretched = notes(3.4e9, **attenuating)
    assert "extrapolation of ITU-R P.833, whose table of woodland covers 105.9 to 2117.5 MHz" in stretched
    assert "gamma = 0.47 dB/m and A_m = 42 dB" in stretched
    assert "out of leaf" not in stretched
    assert "Trees at 2.6 GHz" in notes(2.0e9, 2.6e9, **attenuating)
    assert "gamma in leaf divided by 1.2. That is an assumption" in notes(2e9, **attenuating, leaves="out")


def test_angles_are_those_of_the_tilted_antenna(tmp_path: Path) -> None:
    """A tower antenna tilted by 90 degrees sees what is overhead at its horizon, and what is level overhead or below."""
    at = np.arange(0, 30, 0.5)
    rss = {"USRP1": (at, free_space_db(at))}
    data = gathered(flight(tmp_path, 40, rss=rss, link={"channels": {"USRP1": DIPOLES}}))
    (replayed,) = replay_rss(data)
    seen = compare_rss_series(data, data.rss[0], replayed).geometry
    mount = replayed.link.tower_arrays["LW1"].mount
    ray = replayed.poses.position_m - data.site.towers["LW1"].position_m
    upward = np.degrees(np.arcsin(ray @ mount[:, 2] / np.linalg.norm(ray, axis=1)))
    good = np.isfinite(seen["tower_elevation_deg"])
    np.testing.assert_allclose(seen["tower_elevation_deg"][good], upward, atol=1e-6)
    assert np.abs(seen["tower_elevation_deg"] - seen["elevation_deg"])[good].max() > 20
    assert {"uav_azimuth_deg", "uav_elevation_deg"} <= set(seen)


DIPOLES = {
    "carrier_hz": 3.3e9, "tower": {"antenna": {"model": "dipole"}, "pitch_deg": 90},
    "uav": {"antenna": {"model": "tr38901"}, "yaw_deg": 270},
}  # fmt: skip


def test_the_error_of_means_is_in_the_metrics(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    at = np.arange(0, 60, 0.25)
    (series,) = compared_rss(flight(tmp_path, rss={"USRP1": (at, free_space_db(at) + rng.normal(0, 3, len(at)))}))
    footing = series.further.averaged
    assert footing["coherent"]["0 s"].rmse_db == pytest.approx(series.score.rmse_db)
    assert footing["power_sum"]["4 s"].rmse_db < footing["power_sum"]["0 s"].rmse_db


def test_the_track_of_a_rank_log_with_positions_of_its_own_is_the_logs(tmp_path: Path) -> None:
    at = np.arange(0, 60, 0.5)
    data = gathered(flight(tmp_path, rank=(at, np.full(len(at), 2.0))))
    bare = dataclasses.replace(data, track=None)
    assert track_of(bare) is None
    own = dataclasses.replace(bare.rank[0], position_m=np.column_stack([at, at, at]))
    assert track_of(dataclasses.replace(bare, rank=(own,))).position_m[:, 0] == pytest.approx(at)


def test_reflection_loss_weakens_reflections_only_and_ends_as_free_space(tmp_path: Path) -> None:
    at = np.arange(0, 120, 0.5)
    path = flight(tmp_path, 120, rss={"USRP1": (at, free_space_db(at))})
    levels = {}
    for loss in (0.0, 3.0, 200.0):
        data = gathered(path)
        rt = data.settings.rt.model_copy(update={"reflection_loss_db": loss})
        data = dataclasses.replace(data, settings=data.settings.model_copy(update={"rt": rt}))
        (replayed,) = replay_rss(data)
        levels[loss] = compare_rss_series(data, data.rss[0], replayed)
    ripple = {loss: np.nanstd(p.simulated_dbm - p.baselines["free_space"].level_dbm) for loss, p in levels.items()}
    assert ripple[0.0] > ripple[3.0] > 0.1
    assert ripple[200.0] < 1e-6, "only the line of sight is left"


def test_a_ratio_to_noise_is_not_taken_for_a_level_in_silence(tmp_path: Path) -> None:
    at = np.arange(0, 60, 0.5)
    level = free_space_db(at)
    data = gathered(flight(tmp_path, rss={"power": (at, level), "quality": (at, level + 60)}))
    said = [text for text in data.warnings if "ratio to the noise" in text]
    assert len(said) == 1
    assert said[0].startswith("quality.csv: 'quality'")


@pytest.fixture(scope="module")
def without_one_row(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The numbers of a flight, the row of its 30th level left out."""
    folder, at = tmp_path_factory.mktemp("without"), np.arange(0, 60, 0.5)
    path = flight(folder, rss={"USRP1": (at, free_space_db(at))})
    lines = (folder / "USRP1.csv").read_text().splitlines()
    (folder / "USRP1.csv").write_text("\n".join(line for i, line in enumerate(lines) if i != 30) + "\n")
    assert main(["report", str(path), "-o", str(folder / "out")]) == 0
    channel: dict[str, Any] = json.loads((folder / "out" / "metrics.json").read_text())["rss"]["LW1"]["USRP1"]
    return channel


@pytest.mark.parametrize("absurd", ["inf", "1e30", "500", "-inf", "1e308", "strong"])
def test_one_absurd_level_changes_no_number_and_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], absurd: str, without_one_row: dict[str, Any]
) -> None:
    at = np.arange(0, 60, 0.5)
    path = flight(tmp_path, rss={"USRP1": (at, free_space_db(at))})
    lines = (tmp_path / "USRP1.csv").read_text().splitlines()
    lines[30] = lines[30].split(",")[0] + "," + absurd
    (tmp_path / "USRP1.csv").write_text("\n".join(lines) + "\n")
    metrics = report_completes(path, capsys)
    channel = metrics["rss"]["LW1"]["USRP1"]
    if absurd == "-inf":  # a level in decibels that means no signal
        assert channel["n_out_of_coverage"] == 1
    else:
        flag = "level_out_of_range" if absurd[0].isdigit() else "no_number"
        assert channel["n_flagged"] == {flag: 1}
        assert any(f"1 row is flagged {flag}" in text for text in metrics["warnings"])
        assert channel["n_out_of_coverage"] == 0
    for key in ("offset_db", "rmse_db", "n", "at_search_edge"):
        assert channel[key] == pytest.approx(without_one_row[key]), key


@pytest.mark.parametrize(
    ("written", "instead", "words"),
    [
        ("t,lat,lon", "t,lon,lat", r"at least \d+ km from every tower.*latitude and longitude are swapped"),
        (",-78.", ",78.", "the sign of the longitude is wrong: west is negative"),
        (",35.", ",36.", r"at least 1\d\d km from every tower.*another site"),
    ],
)
def test_exchanged_or_mirrored_angles_are_told_before_anything_else(
    tmp_path: Path, written: str, instead: str, words: str
) -> None:
    at = np.arange(0, 60, 0.5)
    path = flight(tmp_path, rss={"USRP1": (at, free_space_db(at))})
    table = (tmp_path / "track.csv").read_text()
    (tmp_path / "track.csv").write_text(table.replace(written, instead))
    with pytest.raises(InputError, match=words):
        gathered(path)


def rank_with_positions(folder: Path, origin: str = ORIGIN) -> Path:
    """A flight whose rank log has separate positions, in addition to telemetry with attitude."""
    at = np.arange(1.0, 59.0)
    rank = np.where(at % 2, 1.0, 2.0)
    path = flight(folder, rank=(at, rank))
    place = (np.full(len(at), LW1[0] + 5e-4), LW1[1] + (at - 10) * 5 / 90_314.0, np.full(len(at), 40.0))
    write_csv(folder / "ri.csv", "t,ri,lat,lon,alt", at, rank, *place)
    content = yaml.safe_load(path.read_text())
    content["logs"][1]["columns"] |= POSITIONS
    content["logs"][1]["time_origin"] = origin
    return write_yaml(path, content)


def test_a_rank_log_without_a_clock_may_be_of_another_flight(tmp_path: Path) -> None:
    path = rank_with_positions(tmp_path)
    # the mapped heights of a track at 40 m are another doubt
    assert not [text for text in gathered(path).doubts if "clock" in text], "nor has the track a clock"
    content = yaml.safe_load(path.read_text())
    del content["logs"][0]["time_origin"]
    track = pd.read_csv(tmp_path / "track.csv")
    track["t"] += pd.Timestamp(ORIGIN).timestamp()
    track.to_csv(tmp_path / "track.csv", index=False)
    (doubt,) = (text for text in gathered(write_yaml(path, content)).doubts if "clock" in text)
    assert doubt == "ri.csv has no clock: by its positions it may belong to another flight on this route"


def test_logged_attitude_acts_on_rank_logs_with_positions(tmp_path: Path) -> None:
    by_mode = {}
    for mode in ("logged", "ignored"):
        folder = tmp_path / mode
        folder.mkdir()
        data = gathered(rank_with_positions(folder))
        rt = data.settings.rt.model_copy(update={"attitude": mode})
        data = dataclasses.replace(data, settings=data.settings.model_copy(update={"rt": rt}))
        assert data.rank[0].position_m is not None
        (by_mode[mode],) = replay_rank(data)
    assert np.array_equal(by_mode["logged"].poses.position_m, by_mode["ignored"].poses.position_m), "of the log itself"
    turned = by_mode["logged"].poses.rotation
    assert np.allclose(turned, rotation_from_aircraft(np.zeros(58), np.zeros(58), np.full(58, 120.0)), atol=1e-6)
    assert np.allclose(by_mode["ignored"].poses.rotation, np.eye(3))
    assert not np.allclose(by_mode["logged"].replay.h, by_mode["ignored"].replay.h, rtol=1e-3, atol=0)


def test_an_attitude_that_cannot_act_is_the_first_warning(tmp_path: Path) -> None:
    data = gathered(rank_with_positions(tmp_path, "2025-06-02T14:00:00Z"))
    assert data.warnings[0].startswith(
        "rt.attitude: logged has no effect on rank of LW1: no sample is within the telemetry"
    )
    data = gathered(rank_with_positions(tmp_path))
    assert not any("rt.attitude" in text for text in data.warnings)


def test_positions_that_the_rank_log_lacks_come_from_the_track(tmp_path: Path) -> None:
    path = rank_with_positions(tmp_path)
    table = (tmp_path / "ri.csv").read_text().splitlines()
    table[20] = ",".join(table[20].split(",")[:2]) + ",,,"
    (tmp_path / "ri.csv").write_text("\n".join(table) + "\n")
    data = gathered(path)
    assert np.isnan(data.rank[0].position_m[19]).all()
    (replayed,) = replay_rank(data)
    assert replayed.valid.all()
    assert replayed.poses.position_m[19] == pytest.approx(replayed.poses.position_m[[18, 20]].mean(axis=0), abs=0.01)


def snr_flight(folder: Path, above_db: float, **link: float) -> RssResult:
    """The report's numbers of a flight whose log holds level over noise, ``above_db`` of it unexplained."""
    at = np.arange(0, 60, 0.5)
    folder.mkdir()
    level = free_space_db(at) - noise_floor_dbm(20e6, 7.0) + above_db
    return compared_rss(flight(folder, rss={"snr": (at, level)}, link={"rss": {"carrier_hz": 3.3e9, **link}}))[0]


def test_an_snr_is_the_level_over_the_noise_that_is_given(tmp_path: Path) -> None:
    series = snr_flight(tmp_path / "a", 2.5, bandwidth_hz=20e6, noise_figure_db=7)
    snr = series.further.snr
    assert snr.noise_dbm == pytest.approx(-93.96, abs=0.01)  # kTB of 20 MHz at 290 K and 7 dB
    without_offset = snr_flight(tmp_path / "b", 0.0, bandwidth_hz=20e6, noise_figure_db=7).further.snr
    assert snr.mean_error_db - without_offset.mean_error_db == pytest.approx(2.5, abs=1e-9)
    assert snr.rmse_db == pytest.approx(np.hypot(series.further.snr.mean_error_db, series.score.rmse_db), abs=0.01)
    wider = snr_flight(tmp_path / "c", 0.0, bandwidth_hz=40e6, noise_figure_db=7).further.snr
    assert wider.mean_error_db - without_offset.mean_error_db == pytest.approx(10 * np.log10(2.0), abs=1e-6)


def test_the_noise_under_an_snr_cuts_nothing_off(tmp_path: Path) -> None:
    deaf = snr_flight(tmp_path / "a", 0.0, bandwidth_hz=1.0, noise_figure_db=154.0)
    assert deaf.score.n == 120  # a level below -20 dBm would be out of coverage
    assert deaf.further.snr.noise_dbm == pytest.approx(-20.0, abs=0.05)
    assert snr_flight(tmp_path / "b", 0.0).further.snr is None


@pytest.mark.parametrize(
    ("low_db", "floor_low_db", "expected"),
    [(3.4, None, True), (3.6, None, False), (np.nan, None, True), (3.4, 7.6, True), (3.4, 7.8, False)],
)
def test_an_expectation_that_the_flight_refutes_is_withdrawn(
    monkeypatch: pytest.MonkeyPatch, low_db: float, floor_low_db: float | None, expected: bool
) -> None:
    """Held-out flights had 3.5 dB, or 7.7 dB with the floor. If the interval begins above, there is another cause."""
    errors = Errors(series=2, rmse_db=3.5, rmse_4s_db=2.8, free_space_rmse_db=6.1, inside_90=0.9)
    monkeypatch.setattr(compare_flight, "errors_elsewhere", lambda *_: (errors, "at a height that was not flown"))
    data = SimpleNamespace(settings=SimpleNamespace(learned={}))
    lock = SimpleNamespace(floor_rmse_db=7.7, free_space_floor_rmse_db=9.9)
    monkeypatch.setattr(compare_flight, "lock_elsewhere", lambda *_: lock)
    locks = floor_low_db is not None
    floored = SimpleNamespace(rmse_ci95_db=(floor_low_db, 12.0)) if locks else None
    series = SimpleNamespace(locked=np.ones(3) if locks else None)
    case = SimpleNamespace(data=data, series=series, replayed=SimpleNamespace(learned=None))
    known = compare_flight._elsewhere(case, SimpleNamespace(rmse_ci95_db=(low_db, 9.0)), floored)
    assert (known is not None and known["rmse_db"] == 3.5) == expected
    assert known is None or known["kind"] == "at a height that was not flown"


def test_the_band_of_a_receiver_that_loses_its_lock_has_two_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Locked levels are distributed about the prediction and the mean error.

    Without lock, they are distributed about the level of other flights.
    """
    learned = {"gain_db": -100.0, "per_db": 0.1, "share": 0.7, "locked_db": -50.0, "locked_per_db": 0.8}
    lock = SimpleNamespace(**learned, locked_sd_db=7.0, lost_db=-27.0, lost_per_db=0.5, lost_sd_db=8.0)
    monkeypatch.setattr(compare_flight, "lock_elsewhere", lambda *_: lock)
    case = SimpleNamespace(
        series=SimpleNamespace(locked=np.array([1.0, 1.0, 0.0]), link=SimpleNamespace(transmit_power_dbm=40.0)),
        data=SimpleNamespace(settings=SimpleNamespace(learned={})),
        levels=SimpleNamespace(simulated_db=np.array([-50.0, -60.0, -70.0])),
    )
    score = SimpleNamespace(residual_db=np.array([2.0, 4.0, -9.0]), offset_db=-5.0)
    stated = StatedSpread(gain_sd_db=np.ones(3), spread=NO_SPREAD)
    parts = compare_flight._with_lock(case, score, stated).lock
    # path gains 10, 0 and -10 dB from -100; in lock it measured -43 and -51, 1 dB below what others did at these gains
    assert parts.locked_db == pytest.approx([3.0 - 1.0, 3.0 + 1.0, 3.0 + 3.0])
    assert parts.probability == pytest.approx(1.0 / (1.0 + np.exp([-0.9, 0.1, 1.1])))
    lost_db = [-27.0 + shift - 5.0 + level for shift, level in ((4.5, 50), (-0.5, 60), (-5.5, 70))]
    assert parts.lost_db == pytest.approx(lost_db)
    assert (parts.locked_sd_db, parts.lost_sd_db) == (7.0, 8.0)
    case.series.locked = None
    assert compare_flight._with_lock(case, score, stated) is stated


@pytest.mark.parametrize("used", ["level", "ignored"])
def test_a_mirrored_track_without_attitude_mirrors_its_course(monkeypatch: pytest.MonkeyPatch, used: str) -> None:
    """The nose follows the course, so north-east by east becomes north-east by north."""
    heading = np.array([56.25, 0.0, 200.0])
    rotation = rotation_from_aircraft(0.0 * heading, 0.0 * heading, heading)
    position_m = np.array([[1.0, 2.0, 40.0], [9.0, 2.0, 40.0], [9.0, 5.0, 40.0]])
    poses = SimpleNamespace(position_m=position_m, rotation=rotation)
    replayed: Any = SimpleNamespace(
        poses=poses, track=SimpleNamespace(attitude_known=np.zeros(3, dtype=np.bool_)),
        link=SimpleNamespace(uav_array=SimpleNamespace(patterns=())),
    )  # fmt: skip
    begin = SimpleNamespace(position_m=poses.position_m[:1])
    data: Any = SimpleNamespace(
        track=SimpleNamespace(start_ns=0, pose_at=lambda _: begin), settings=SimpleNamespace(rss_attitude=used)
    )
    monkeypatch.setattr(likely_cause._Direct, "level", lambda _, **at: at)
    link = likely_cause._Direct(site=None, tower="LW1", replayed=replayed, rotations={})  # type: ignore[arg-type]
    ((meaning, at),) = link.misread_db(data, np.zeros(3, dtype="datetime64[ns]"), False).items()
    assert meaning == "east and north of the track are swapped"
    np.testing.assert_allclose(at["position_m"], [[1.0, 2.0, 40.0], [1.0, 10.0, 40.0], [4.0, 10.0, 40.0]])
    mirrored = rotation_from_aircraft(0.0 * heading, 0.0 * heading, 90.0 - heading)
    if used == "level":
        np.testing.assert_allclose(at["rotation"], mirrored, atol=1e-12)
    else:
        assert at["rotation"] is None  # that of the replay


@pytest.mark.parametrize("name", ["sign", "decibels"])
def test_a_flight_logged_as_path_loss_or_with_half_the_decibels_is_named(tmp_path: Path, name: str) -> None:
    corners = [
        (20, 30, 0),
        (20, 30, 40),
        (300, 50, 40),
        (300, -200, 40),
        (500, -200, 60),
        (500, 150, 60),
        (100, 250, 50),
    ]
    corners += [(-200, 250, 40), (-200, -50, 40), (20, 30, 40)]
    plan = {"fading_db": 1.0}
    simulate(write_yaml(tmp_path / "f.yaml", planned("f", corners, {"LW1": {"A": 0.0}}, plan=plan)))
    log, changed = tmp_path / "f" / "LW1_A.txt", (lambda level: 20.0 - level if name == "sign" else 0.5 * level)
    log.write_text(re.sub(r"-[\d.]+$", lambda found: f"{changed(float(found[0])):.4f}", log.read_text(), flags=re.M))
    draft = tmp_path / "draft.yaml"
    assert main(["ingest", str(log.parent), "--timezone", "America/New_York", "--draft", str(draft), "--quiet"]) == 0
    cause = run_flight(load_data(load_flight(draft), tmp_path), audit=False).result.likely_cause
    assert (cause is not None and cause.name) == name
