"""The model comparison of a flight with known truth, from logs to page and recommended flight file."""

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.yamlfile import edited
from aerpaw_cmp.compare.result import Cause
from aerpaw_cmp.compare.statistics import paired_difference
from aerpaw_cmp.flight.data import load_data
from aerpaw_cmp.flight.drafting.proposals import offered
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.flight_run import (
    Model,
    _ModelSearch,
    cause_beyond_models,
    next_step,
    recommended_changes,
    run_flight,
)
from aerpaw_cmp.site.learned import Errors, folder_of, sphere_csv, store_entry, unit_mean_gain
from tests.learned_entries import learned_entry, learned_series, learned_tables
from tests.simulated import planned, simulate, write_yaml
from tests.tables import eastwards, rss_log

pytestmark = pytest.mark.usefixtures("few_pictures")


def flight(folder: Path, exponent: float = 2.0) -> Path:
    """Write a flight eastwards past LW1 at 40 m.

    The levels are log-distance plus noise, and the flight file has a coherent ground reflection.
    """
    t, at = np.arange(0.0, 121.0), np.arange(0.0, 120.0, 0.2)
    range_m = np.sqrt((-500.0 + 8.0 * at) ** 2 + 55.0**2 + 30.0**2)
    level = -30.0 - 10.0 * exponent * np.log10(range_m) + np.random.default_rng(1).normal(size=len(at))
    return write_yaml(folder / "flight.yaml", {
        "flight": "planted", "site": {"file": "lake_wheeler", "without_buildings": True},
        "logs": [eastwards(folder, t, -500.0 + 8.0 * t), rss_log(folder, "A", at, level)],
        "rt": {"max_depth": 1, "audit_links": 0}, "rss": {"lag": "off", "span_db": [-100, 100]},
    })  # fmt: skip


def with_model(path: Path, model: Model) -> Path:
    """Return a file next to a flight file, with the keys of a model."""
    text = path.read_text(encoding="utf-8")
    changes = recommended_changes(load_flight(path), yaml.safe_load(text), model)
    changed = path.with_name(f"{path.stem}_changed.yaml")
    changed.write_text(edited(text, changes), encoding="utf-8")
    return changed


def report(path: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    assert main(["report", str(path), "-o", str(path.parent / "out"), "--json", *more]) == 0
    metrics: dict[str, Any] = json.loads(capsys.readouterr().out)
    return metrics


def test_free_space_is_found_said_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = flight(tmp_path)
    path.write_text(f"# mine\n{path.read_text()}# the end\n")
    better = tmp_path / "better.yaml"
    metrics = report(path, capsys, "--recommend", str(better))
    assert "--recommend" in metrics["next_step"]
    rows = {row["model"]: row for row in metrics["ladder"]}
    assert [name for name, row in rows.items() if row["recommended"]] == ["free space"]
    assert rows["free space"]["rmse_heldout_db"] == pytest.approx(1.0, abs=0.1)
    as_set = rows["as set in flight.yaml"]
    assert as_set["rmse_heldout_db"] == pytest.approx(rows["coherent ground reflection"]["rmse_heldout_db"], abs=1e-6)
    assert as_set["difference_to_best_db"] > 0.2
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "free space 1.0 dB" in page[page.index('id="ladder"') :][:400]  # the first sentence of the verdict
    assert "Models from the simplest to the most complex" in page

    seal, *lines = better.read_text().splitlines()
    mine = path.read_text().splitlines()
    assert seal.startswith("# aerpaw-cmp wrote this file")
    changed = [line for line in mine if line not in lines]
    assert all("max_depth" in line for line in changed)  # all lines, with their comments and order
    assert [line for line in lines if line in mine] == [line for line in mine if line in lines]
    assert len(lines) == len(mine)

    again = run_flight(load_data(load_flight(better), tmp_path), audit=False, ladder=True).result
    assert again.next_step is None  # followed once, the advice ends, and noise alone is nothing to calibrate
    assert [row.model for row in again.ladder if row.recommended] == ["as set in flight.yaml"]
    assert again.rss[0].score.rmse_db == pytest.approx(1.0, abs=0.1)
    as_set = {r.model: r for r in again.ladder}["as set in flight.yaml"]
    assert as_set.rmse_heldout_db == pytest.approx(rows["free space"]["rmse_heldout_db"], abs=1e-6)


def test_a_reflection_is_seen_where_a_wood_hides_it_from_free_space(tmp_path: Path) -> None:
    """Woods take 10 dB, the ground 2: without its woods no flight asks for a ground."""
    route = [(-60, 10, 30), (-250, 60, 30), (-100, 260, 40), (160, 160, 40), (200, -150, 30)]
    keys = {"rt": {"foliage": "attenuating", "audit_links": 0}, "rss": {"lag": "off", "minimum_height_m": 20}}
    path = write_yaml(tmp_path / "flight.yaml", planned("woods", route, {"LW4": {"A": 5.0}}, **keys))
    simulate(path)
    models = run_flight(load_data(load_flight(path), tmp_path), audit=False, ladder=True).result.ladder
    assert (
        min(models[:-1], key=lambda row: row.rmse_heldout_db).model
        == "coherent ground reflection + woods as media (p833)"
    )


def test_a_hover_recommends_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At a single position, learned antennas fit like a constant, so the settings are not changed."""
    path, t = remembering(tmp_path, 3.5), np.arange(0.0, 121.0)
    eastwards(tmp_path, t, 200.0 + 4.0 * np.sin(t / 7.0))
    at = np.arange(0.0, 120.0, 0.2)
    rss_log(tmp_path, "A", at, -80.0 + 0.3 * np.random.default_rng(1).normal(size=len(at)))
    rows = {row["model"]: row for row in report(path, capsys)["ladder"]}
    as_set, learned = rows["as set in flight.yaml"], rows["learned antennas + heading"]
    assert as_set["rmse_heldout_db"] > learned["rmse_heldout_db"] + 0.1
    assert [as_set["recommended"], learned["recommended"]] == [True, False]


def test_a_replay_that_loses_to_a_line_says_so_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Levels fall by 40 dB per decade: the two-parameter line is best in report, model comparison and text."""
    metrics = report(flight(tmp_path, 4.0), capsys)
    rss = metrics["rss"]["LW1"]["A"]
    error = {name: fit["rmse_db"] for name, fit in rss["baselines"].items()}
    assert set(error) == {"free_space", "two_ray", "log_distance", "constant"}
    assert error["log_distance"] == pytest.approx(1.0, abs=0.1)
    assert min(error["free_space"], error["constant"]) > 2.0
    assert rss["compared_with"]["log_distance"]["verdict"] == "worse"
    rows = {row["model"]: row for row in metrics["ladder"]}
    assert rows["log-distance line"]["rmse_heldout_db"] == pytest.approx(error["log_distance"], abs=0.2)
    assert rows["log-distance line"]["difference_to_best_db"] == 0.0
    assert "line" not in next(name for name, row in rows.items() if row["recommended"])
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "worse than a log-distance line" in page[: page.index('id="result"')]
    assert "log-distance line" in page[page.index('id="ladder"') :][:400]


def test_learned_antennas_are_scored_on_other_flights_alone(tmp_path: Path) -> None:
    """Learned antennas are a separate model, which is not scored on their training flights."""
    path = flight(tmp_path)
    own = hashlib.sha256((tmp_path / "A.csv").read_bytes()).hexdigest()
    for logs, scored in (("b" * 64, True), (f"{'b' * 64}, {own}", False)):
        notes = (f"aerpaw-cmp calibrate: some, trained_on: {logs}",)
        (tmp_path / "a.csv").write_text(sphere_csv(np.zeros((7, 8)), np.ones((7, 8)), notes))
        settings = load_flight(path)
        stated = settings.model_dump(mode="json", exclude_unset=True)
        stated["link"] = {"rss": {"carrier_hz": 3.3e9, "tower": {"antenna": {"model": "sphere", "file": "a.csv"}}}}
        (tmp_path / "learned.yaml").write_text(yaml.safe_dump(stated), encoding="utf-8")
        outcome = run_flight(load_data(load_flight(tmp_path / "learned.yaml"), tmp_path), audit=False, ladder=True)
        rows = {row.model: row for row in outcome.result.ladder}
        learned = {name: row for name, row in rows.items() if "learned antennas" in name or "as set" in name}
        assert len(learned) >= 2
        assert all(np.isfinite(row.rmse_heldout_db) == scored for row in learned.values())
        assert all(("not scored" in name) != scored for name in learned)
        assert np.isfinite(rows["free space"].rmse_heldout_db)
        kept = recommended_changes(load_flight(tmp_path / "learned.yaml"), stated, Model(antennas="learned"))
        assert not any(path[0] in ("link", "antennas") for path in kept)


def remembering(folder: Path, learned_db: float, trained_on: str = "a" * 64, tower: str = "LW1") -> Path:
    """Write the planted flight at a site with learned antennas for its tower and channel.

    The flight file itself names no antennas.
    """
    site = folder / "mine.yaml"
    site.write_bytes(Path(str(folder_of("lake_wheeler"))).with_suffix(".yaml").read_bytes())
    rows, columns = np.mgrid[0:19, 0:24]
    table = 2.0 * np.cos(np.radians(15.0 * columns)) + 0.1 * rows
    table = unit_mean_gain(table)
    sphere = sphere_csv(table, np.ones(table.shape), (f"aerpaw-cmp calibrate: some, trained_on: {trained_on}",))
    errors = Errors(series=2, rmse_db=learned_db, rmse_4s_db=2.0, free_space_rmse_db=5.0, inside_90=0.9)
    entry = learned_entry(learned_series("A", tower=tower), errors=errors, trained_on=[trained_on])
    store_entry(site, "some", entry, learned_tables("A", t=sphere.encode(), u=sphere.encode()))
    path = flight(folder)
    path.write_text(path.read_text().replace("file: lake_wheeler", "file: mine.yaml"), encoding="utf-8")
    return path


@pytest.mark.parametrize(("taught", "own", "fits"), [("ROVER", "NODE", True), ("LW2", "NODE", False)])
def test_a_node_of_the_flight_is_offered_what_rovers_of_others_taught(
    taught: str, own: str, fits: bool, tmp_path: Path
) -> None:
    path = remembering(tmp_path, 3.5, tower=taught)
    node = "{latitude_deg: 35.7275, longitude_deg: -78.6962, antenna_height_m: 1.5}"
    text = path.read_text(encoding="utf-8").replace("LW1", own)
    path.write_text(f"{text}\ntowers: {{{own}: {node}}}\n", encoding="utf-8")
    settings = offered(load_data(load_flight(path), tmp_path))
    assert (settings is not None and f"{own}.A" in settings.antennas) == fits


@pytest.mark.parametrize(("learned_db", "chosen"), [(3.5, True), (5.5, False)])
def test_an_isotropic_flight_is_offered_what_its_site_remembers(
    learned_db: float, chosen: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both models are better than the settings of this flight.

    Whether learned antennas are recommended depends on their error on other flights.
    """
    metrics = report(remembering(tmp_path, learned_db), capsys, "--recommend", str(tmp_path / "best.yaml"))
    candidates = {row["model"]: row for row in metrics["ladder"]}
    assert {"learned antennas", "learned antennas + heading"} <= set(candidates)
    assert candidates["learned antennas + heading"]["recommended"] == chosen
    assert bool(load_flight(tmp_path / "best.yaml").antennas) == chosen
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert ("best on other flights (3.5 dB, free space 5.0 dB)" in page) == chosen
    assert main(["report", str(tmp_path / "best.yaml"), "-o", str(tmp_path / "again"), "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert "--recommend" not in (first["next_step"] or "")  # followed once, the advice ends; what to expect stays
    page = (tmp_path / "again" / "report.html").read_text(encoding="utf-8")
    assert ("Expect 3.5 dB on another flight." in page) == chosen


def test_recommended_file_must_stand_beside_its_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = flight(tmp_path)
    other = tmp_path / "other"
    other.mkdir()
    assert main(["report", str(path), "-o", str(tmp_path / "out"), "--recommend", str(other / "b.yaml")]) == 2
    assert "in the folder of the flight file" in capsys.readouterr().err
    assert main(["report", str(path), "-o", str(tmp_path / "out"), "--recommend", str(path), "--force"]) == 2


@pytest.mark.parametrize(
    "model",
    [
        Model(),
        Model(antennas="measured", attitude="logged", ground="weakened", trees="p833"),
        Model(antennas="learned", attitude="level", ground="power sum", buildings=True, trees="opaque"),
    ],
)
def test_every_model_is_a_flight_file(model: Model, tmp_path: Path) -> None:
    stated = load_flight(flight(tmp_path)).model_dump(mode="json", exclude_unset=True)
    antenna = {"model": "gain_grid", "file": "a.mat", "variable": "g"}
    stated["link"] = {"rss": {"carrier_hz": 3.3e9, "tower": {"antenna": antenna}, "uav": {"antenna": {**antenna}}}}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(stated), encoding="utf-8")
    settings = load_flight(with_model(tmp_path / "a.yaml", model))
    assert settings.link.rss.uav.antenna.model == ("iso" if model.antennas == "isotropic" else "gain_grid")
    assert settings.site.without_buildings is not model.buildings
    assert settings.rt.attitude == model.attitude
    assert (settings.rt.max_depth > 0) is (model.ground != "none")
    assert (settings.rss.field == "power") is (model.ground == "power sum")
    assert (settings.rt.foliage == "none") is (model.trees == "none")


def test_a_recommended_model_removes_diffraction(tmp_path: Path) -> None:
    """No compared model has it, so the written file must replay what was scored."""
    path = flight(tmp_path)
    stated = yaml.safe_load(path.read_text(encoding="utf-8"))
    path.write_text(yaml.safe_dump({**stated, "rt": {**stated["rt"], "diffraction": "edges"}}), encoding="utf-8")
    assert load_flight(path).rt.diffraction == "edges"
    assert load_flight(with_model(path, Model(ground="power sum", buildings=True))).rt.diffraction == "none"


def test_channels_that_share_a_replay_cost_its_seconds_once() -> None:
    """Ten channels of one replay of 5 s, and one of another tower of 2 s: 7 s, not 52 s."""
    rss = [SimpleNamespace(tower="LW1", settings_key="{}")] * 10 + [SimpleNamespace(tower="LW2", settings_key="{}")]
    search = SimpleNamespace(_data=SimpleNamespace(rss=rss))
    assert _ModelSearch._of_flight(search, [5.0] * 10 + [2.0]) == 7.0  # type: ignore[arg-type]
    other = [*rss[:2], SimpleNamespace(tower="LW1", settings_key='{"carrier_hz": 1}')]
    assert _ModelSearch._of_flight(SimpleNamespace(_data=SimpleNamespace(rss=other)), [5.0, 4.0, 3.0]) == 8.0  # type: ignore[arg-type]


@pytest.mark.parametrize(("share", "line", "gains"), [(0.98, 2, False), (0.9, 2, True), (0.9, 0.9, False)])
def test_a_gain_that_no_page_could_show_is_no_advice(share: float, line: float, gains: bool) -> None:
    """Improvements of 0.06 and 0.3 dB from 3 dB are significant, but not for a constant level at one position."""
    error_db = 3.0 * np.random.default_rng(1).normal(size=3000)
    search = _ModelSearch.__new__(_ModelSearch)
    search._series = [SimpleNamespace(time_s=np.arange(3000.0))]  # type: ignore[list-item]
    errors = ([line * error_db], [share * error_db], [error_db])
    ladder = SimpleNamespace(recommended=1, error_db=errors, position_m=[np.full((3000, 3), np.nan)])
    assert paired_difference(share * error_db, error_db).verdict == "better"
    assert search._is_better(ladder) == gains  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "explained_db", "stays"), [("blocked", 0.4, False), ("blocked", 0.9, True), ("lock", 0.4, True)]
)
def test_a_loss_over_directions_is_no_cause_where_another_model_explains_as_much(
    name: str, explained_db: float, stays: bool
) -> None:
    """The recommended model gains 0.7 dB on the flight as set."""
    cause = Cause(name=name, sentence="", next_step="", rmse_db=3.4, rmse_with_db=3.4 - explained_db)
    ladder = SimpleNamespace(recommended=0, rmse_db=(3.0, 5.0, 3.7))
    comparison: Any = SimpleNamespace(recommended=Model(), scores=ladder)
    assert (cause_beyond_models(cause, comparison) is cause) == stays
    comparison.recommended = None
    assert cause_beyond_models(cause, comparison) is cause


@pytest.mark.parametrize(("rss", "rank", "step"), [
    ("", "", "look there"), ("learned", "", "calibrate FLIGHT FLIGHT` with other"), ("", "learned", "look there"),
    (None, "learned", "calibrate CALIBRATION` with `rank: true` and other"),
    ("learned", "learned", "calibrate CALIBRATION` with `rank: true` and other"),
])  # fmt: skip
def test_the_step_of_a_training_flight_scores_it(rss: str | None, rank: str, step: str) -> None:
    """It is not the step against a cause, which the summary leaves out, or against an offset that is not scored."""
    panels = [[SimpleNamespace(score=SimpleNamespace(at_edge=bool(learned)), further=SimpleNamespace(trained_on=learned))]
              for learned in (rss, rank)]  # fmt: skip
    cause = Cause(name="lock", sentence="", next_step="look there")
    result: Any = SimpleNamespace(rss=[] if rss is None else panels[0], rank=panels[1], likely_cause=cause)
    data: Any = None
    assert step in (next_step(data, result, None) or "")
