"""Rank parameters fitted on some flights and scored on others: planted mounts and K are found again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.flight.data import FlightData, gather, read_logs
from aerpaw_cmp.flight.settings import load_flight
from aerpaw_cmp.jobs.campaigns.campaign import load_campaign
from aerpaw_cmp.jobs.campaigns.campaign_fit import HeldOutSettings, search
from aerpaw_cmp.jobs.campaigns.campaign_rank_fit import RankBench, fit_rank_all, loss, shares_by_rank

pytestmark = pytest.mark.usefixtures("few_pictures")

PLANTED = {"link.rank.uav.yaw_deg": 90.0, "rank.k": 20.0}
GRIDS = {"link.rank.uav.yaw_deg": [0.0, 45.0, 90.0, 135.0], "rank.k": [5.0, 10.0, 20.0, 40.0]}
REPORTS = 160


def fitted(flights: dict[str, FlightData], fit: Any, fit_on: list[str] | None, criterion: str) -> list[Any]:
    return fit_rank_all(flights, HeldOutSettings.model_validate({"fit": fit, "fit_on": fit_on, "criterion": criterion}))


def flight(folder: Path, name: str, north_deg: float) -> FlightData:
    """A flight past LW1 at 40 m whose log reports rank 1 throughout."""
    t = np.arange(0.0, 80.5, 0.5)[:REPORTS]
    rows = [f"{s:.1f},1,{35.7275 + north_deg:.7f},{-78.6985 + s * 6e-5:.7f},40" for s in t]
    (folder / f"{name}.csv").write_text("t,ri,lat,lon,alt\n" + "\n".join(rows) + "\n", encoding="utf-8")
    (folder / f"{name}.yaml").write_text(
        f"flight: {name}\nsite: {{file: lake_wheeler, without_buildings: true}}\nlogs:\n"
        f"  - {{path: {name}.csv, reader: generic_csv, kind: rank, node: LW1, ri_base: one, "
        'time_origin: "2024-07-02T12:00:00Z", columns: {time: t, ri_raw: ri, latitude_deg: lat, longitude_deg: lon, '
        "altitude_m: alt}}\nrt: {max_depth: 1}\nrank: {minimum_height_m: 5, advanced: {bootstrap: 0}}\n",
        encoding="utf-8",
    )
    settings = load_flight(folder / f"{name}.yaml")
    return gather(settings, folder, read_logs(settings, folder))


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FlightData]:
    """Two flights that report what the planted mount and K give."""
    folder = tmp_path_factory.mktemp("rank_fit")
    out = {}
    for name, north in (("one", 8e-4), ("two", -6e-4)):
        data = flight(folder, name, north)
        said = RankBench(data).pairs(PLANTED)[1]
        assert len(said) == REPORTS
        series = dataclasses.replace(data.rank[0], rank=said.astype(np.float64))
        out[name] = dataclasses.replace(data, rank=(series,))
    return out


@pytest.mark.parametrize("criterion", ["kappa", "log_score", "total_variation"])
def test_planted_mount_and_k_are_found_on_the_other_flight(flights: dict[str, FlightData], criterion: str) -> None:
    folds = fitted(flights, GRIDS, None, criterion=criterion)
    assert [fold.applied_to for fold in folds] == [("one",), ("two",)]
    for fold in folds:
        (held,) = [row for row in fold.rows if not row.fitted_here]
        assert held.flight not in fold.fitted_on
        assert held.n == REPORTS
        if criterion == "total_variation":  # shares alone do not say which pose has which rank
            assert held.fit_total_variation < 0.05
            continue
        assert fold.parameters == PLANTED
        assert held.fit_kappa == held.fit_agreement == 1.0
        assert held.start_kappa < 0.9
        assert held.fit_log_score < held.start_log_score
        assert held.fit_log_score < held.constant_log_score


def test_a_key_without_effect_is_among_what_cannot_be_told_apart(flights: dict[str, FlightData]) -> None:
    grids = {"link.rank.uav.yaw_deg": [90.0], "rank.k": [20.0], "rt.advanced.maximum_gap_s": [3.0, 4.0]}
    (fold,) = fitted(flights, grids, ["one"], criterion="kappa")
    assert fold.ties == ({"link.rank.uav.yaw_deg": 90.0, "rank.k": 20.0, "rt.advanced.maximum_gap_s": 4.0},)
    (other,) = fitted(flights, {"rank.k": [20.0, 2.0], "link.rank.uav.yaw_deg": [90.0]}, ["one"], criterion="kappa")
    assert other.ties == ()  # a K of 2 misses most reports


def test_values_may_be_lists_and_long_products_are_searched_key_by_key(flights: dict[str, FlightData]) -> None:
    slants = [[0.0, 0.0, 0.0, 0.0], [45.0, -45.0, -45.0, 45.0]]
    (fold,) = fitted(flights, {"link.rank.uav.slant_deg": slants, **GRIDS}, ["one"], criterion="kappa")
    assert fold.parameters == {"link.rank.uav.slant_deg": slants[1], **PLANTED}
    many = {"rank.k": [20.0, *np.linspace(30, 300, 600).tolist()], "link.rank.uav.yaw_deg": [90.0]}
    few = [RankBench(flights["one"]).thinned(40)]
    found = search(lambda point: loss(few, point, "kappa"), many)
    assert found.method.startswith("one parameter")
    assert found.point["rank.k"] == 20.0


def test_the_log_score_of_a_flight_takes_the_shares_of_the_others(flights: dict[str, FlightData]) -> None:
    both = loss([RankBench(flights[name]) for name in flights], PLANTED, "log_score")
    swapped = dataclasses.replace(flights["two"].rank[0], rank=np.full(REPORTS, 4.0))
    strange = dataclasses.replace(flights["two"], rank=(swapped,))
    assert loss([RankBench(flights["one"]), RankBench(strange)], PLANTED, "log_score") > both + 1.0
    table = shares_by_rank(np.array([1, 1, 2]), np.array([1, 1, 1]))
    assert table.sum(axis=1) == pytest.approx(np.ones(4))
    assert table[0, 0] > table[0, 1] > table[0, 2] > 0.0


def test_refusals(flights: dict[str, FlightData]) -> None:
    with pytest.raises(UsageError, match="1 flights with rank"):
        fitted({"one": flights["one"]}, GRIDS, None, criterion="kappa")
    with pytest.raises(UsageError, match="fit_on gave rank"):
        fitted(flights, GRIDS, ["three"], criterion="kappa")
    silent = dataclasses.replace(flights["one"].rank[0], rank=np.full(REPORTS, np.nan))
    none = {"one": dataclasses.replace(flights["one"], rank=(silent,)), "two": flights["two"]}
    with pytest.raises(InputError, match="nothing can be fitted on one"):
        fitted(none, GRIDS, ["one"], criterion="kappa")


def test_a_fit_takes_the_flights_that_gave_rows_under_its_own_setting() -> None:
    from types import SimpleNamespace as Row

    from aerpaw_cmp.jobs.campaigns.campaign import _tasks_of_fit
    from aerpaw_cmp.jobs.campaigns.campaign_tasks import Task

    settings = HeldOutSettings.model_validate({"fit": {"rank.k": [10.0]}, "criterion": "kappa", "setting": "a"})
    tasks = [Task(Path(f"{f}.yaml"), f, s, {}, None) for s in ("a", "b") for f in ("one", "two")]
    rows: Any = [Row(flight="one", setting="a"), Row(flight="one", setting="b"), Row(flight="two", setting="b")]
    label, of = _tasks_of_fit(settings, tasks, rows)
    assert (label, list(of)) == ("a", ["one"])  # two gave rank under b alone
    assert of["one"].setting == "a"


def campaign_file(folder: Path, held_out: str) -> Path:
    path = folder / "campaign.yaml"
    path.write_text(f"campaign: c\nflights: [one.yaml, two.yaml]\nheld_out: {held_out}\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("held_out", "says"),
    [
        ("{fit: {rank.k: [10, 20]}}", "criterion: kappa"),
        ("{fit: {rss.lag: [1, 2]}, criterion: kappa}", "rank.k"),
        ("{fit: {link.rank.uav.slant_deg: [[0, 0, 0, 0], [45, -45, 45, -45]]}}", "rank alone"),
        ("{fit: {rank.k: [20, 10]}, criterion: kappa}", "increasing"),
    ],
)
def test_what_a_campaign_cannot_fit_is_refused_by_name(tmp_path: Path, held_out: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        load_campaign(campaign_file(tmp_path, held_out))
    assert says in str(caught.value)


def test_a_campaign_writes_its_rank_fit(tmp_path: Path) -> None:
    for name, north in (("one", 8e-4), ("two", -6e-4)):
        said = RankBench(flight(tmp_path, name, north)).pairs(PLANTED)[1]
        rows = (tmp_path / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        rows[1:] = [
            ",".join([t, str(r), *rest])
            for (t, _, *rest), r in zip((x.split(",") for x in rows[1:]), said, strict=True)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    fit = "{fit: {link.rank.uav.yaw_deg: [0, 45, 90, 135], rank.k: [5, 10, 20, 40]}, criterion: kappa}"
    out = tmp_path / "out"
    assert main(["campaign", str(campaign_file(tmp_path, fit)), "-o", str(out), "--quiet"]) == 0
    folds = json.loads((out / "campaign.json").read_text(encoding="utf-8"))["held_out"]["rank"]
    assert [fold["parameters"] for fold in folds] == [PLANTED, PLANTED]
    assert all(row["fit_kappa"] == 1.0 for fold in folds for row in fold["scores"])
    page = (out / "campaign.html").read_text(encoding="utf-8")
    assert "Rank fitted on two: on one kappa goes from" in page
