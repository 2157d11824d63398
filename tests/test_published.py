"""The published benchmark on made-up flights: splits, entries, scores by a second way, refusals."""

import ast
import dataclasses
import gzip
import hashlib
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import aerpaw_cmp
from aerpaw_cmp.common.errors import InputError, UsageError
from benchmarks.published import __main__ as published
from benchmarks.published import entrants, tasks
from benchmarks.published.score import block_of, bootstrap_means, intervals, rmse_replicates
from tests.compare.test_entries import LONG, SHORT
from tests.real_logs import REAL

FOLDER = Path(entrants.__file__).parent
FLIGHT = """
    timezone: UTC
    site: {{file: {site}}}
    logs:
      - {{path: {name}, columns: {{time: time, latitude_deg: latitude_deg, longitude_deg: longitude_deg, altitude_m: altitude_m}}, kind: telemetry, reader: generic_csv}}
      - {{path: {name}, node: T1, columns: {{time: time, rss_db: level}}, kind: rss, unit: dBm, reader: generic_csv}}
    link: {{rss: {{carrier_hz: 3.3e9}}}}
    rss: {{minimum_height_m: 5, lag: off, span_db: [-150, 150]}}
"""
SITE = """
name: made up
origin: {latitude_deg: 35.7275, longitude_deg: -78.696}
towers:
  T1: {latitude_deg: 35.7275, longitude_deg: -78.696, antenna_height_m: 10}
"""


def made_log(seed: int, height: float) -> str:
    """A spiral round the tower: 35 dB per decade, a slow fade, noise of 2 dB."""
    draw = np.random.default_rng(seed)
    t = np.arange(400)
    radius, turn = 80.0 + 0.6 * t, t / 23.0 + seed
    east, north = radius * np.cos(turn), radius * np.sin(turn)
    distance = np.sqrt(east**2 + north**2 + (height - 10.0) ** 2)
    level = -20.0 - 35.0 * np.log10(distance) + 3.0 * np.sin(t / 15.0) + draw.normal(0.0, 2.0, len(t))
    rows = ["time,latitude_deg,longitude_deg,altitude_m,level"]
    for i in range(len(t)):
        stamp = f"2025-06-01T{12 + seed:02d}:{t[i] // 60:02d}:{t[i] % 60:02d}Z"
        latitude, longitude = 35.7275 + north[i] / 110_950.0, -78.696 + east[i] / 90_400.0
        rows.append(f"{stamp},{latitude:.7f},{longitude:.7f},{height:.1f},{level[i]:.2f}")
    return "\n".join(rows) + "\n"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark")
    logs = folder / "logs"
    logs.mkdir()
    (folder / "site.yaml").write_text(SITE)
    files, flights = [], []
    for seed, name in enumerate(("known", "asked", "absent")):
        text = made_log(seed, 30.0 + 10.0 * seed).encode()
        digest = hashlib.sha256(text).hexdigest()
        files.append(
            f"  {name}: {{repository: nobody/{name}, path: {name}.csv, bytes: {len(text)}, sha256: {digest}, licence: CC0-1.0}}"
        )
        flights.append(f"  {name}:{FLIGHT.format(site=folder / 'site.yaml', name=name)}")
        if name != "absent":
            (logs / f"renamed_{seed}.csv").write_bytes(text)
    packed = logs / "renamed_1.csv"
    (logs / "packed.gz").write_bytes(gzip.compress(packed.read_bytes()))
    packed.unlink()  # known by content: under another name, and packed
    tasks = """
  unseen: {title: Unseen flight, train: [known], test: [asked, absent]}
  sectors: {title: Unseen sector, split: sectors, train: [known], test: [asked]}
  map: {title: Map, split: blocks, train: [known], test: [asked]}
  halves: {title: Gaps, split: stretches, train: [], test: [asked]}
"""
    (folder / "manifest.yaml").write_text(
        "version: 1\nfiles:\n" + "\n".join(files) + "\nflights:\n" + "\n".join(flights) + f"\ntasks:{tasks}"
    )
    return folder


@pytest.fixture(scope="module")
def bench(place: Path) -> tasks.Bench:
    return tasks.Bench(place / "logs", place / "manifest.yaml")


def entry(place: Path, frame: pd.DataFrame, name: str = "mine", head: str = "") -> Path:
    path = place / f"{name}.csv"
    path.write_text(head + frame.to_csv(index=False))
    return path


def guess(bench: tasks.Bench, task: str = "unseen", **changes: object) -> pd.DataFrame:
    """Return the predictions of a simple third-party model in ten lines of NumPy."""
    table = bench.rows(task)
    distance = np.sqrt(sum((table[f"{a}_m"] - table[f"tower_{a}_m"]) ** 2 for a in ("east", "north", "up")))
    level = -15.0 - 25.0 * np.log10(distance)
    return table[tasks.KEY].assign(**{"level_db": level, "sd_db": 3.0, **changes})


def test_files_are_known_by_content(bench: tasks.Bench) -> None:
    assert sorted(bench.places) == ["asked", "known"]
    assert bench.skipped("unseen", training=True) == ["absent: absent.csv of nobody/absent"]
    assert bench.tests("unseen") == ["asked"]


def test_scores_by_plain_loops(place: Path, bench: tasks.Bench) -> None:
    frame = guess(bench)
    score = published.score(bench, entry(place, frame), [])["unseen"]
    truth = bench.rows("unseen")
    error = [m - p for m, p in zip(truth["measured"], frame["level_db"], strict=True)]
    assert len(error) == 400
    mean = sum(error) / 400
    left = [e - mean for e in error]
    assert score["rmse_db"] == pytest.approx(math.sqrt(sum(e * e for e in left) / 400), abs=1e-9)
    assert score["bias_db"] == pytest.approx(abs(mean), abs=1e-9)
    inside = sum(abs(e) <= 1.6448536269514722 * 3.0 for e in left) / 400
    assert score["coverage_90"] == pytest.approx(inside, abs=1e-9)
    nat = sum(0.5 * (e / 3.0) ** 2 + math.log(3.0 * math.sqrt(2 * math.pi)) for e in left) / 400
    assert score["log_score"] == pytest.approx(nat, abs=1e-9)
    crps = sum(_crps(e, 3.0) for e in left) / 400
    assert score["crps_db"] == pytest.approx(crps, abs=1e-5)  # a step, integrated by trapezia
    low, high = score["rmse_ci95_db"]
    assert low < score["rmse_db"] < high
    assert score["n"] == 400.0


def _crps(error: float, sd: float) -> float:
    """Compute by the definition: the integral of the squared difference of the distributions."""
    x = np.linspace(-60.0, 60.0, 240_001)
    forecast = 0.5 * (1.0 + np.vectorize(math.erf)(x[::40] / sd / math.sqrt(2.0)))
    return float(np.trapezoid((np.interp(x, x[::40], forecast) - (x >= error)) ** 2, x)) if abs(error) < 60 else 0.0


def _bearing(rows: pd.DataFrame) -> np.ndarray:
    return np.degrees(
        np.arctan2(rows["east_m"] - rows["tower_east_m"], rows["north_m"] - rows["tower_north_m"])
    ).to_numpy()


def test_nothing_of_a_fold_is_known(bench: tasks.Bench) -> None:
    folds = 0
    for task, own in (("sectors", False), ("map", True), ("halves", True)):
        times: list[str] = []
        for question in bench.questions(task, "asked"):
            folds += 1
            known, asked = question.known, question.asked
            times += list(asked["time"])
            assert "measured" not in asked
            mine = known[known["flight"] == "asked"]
            assert len(mine) == (len(mine) if own else 0)
            assert own == bool(len(mine))
            if task == "sectors":
                apart = np.abs((_bearing(known)[:, None] - _bearing(asked)[None] + 180.0) % 360.0 - 180.0)
                assert apart.min() > tasks.SECTOR_GUARD_DEG - 1e-9
            elif task == "map":
                place, other = (rows[["east_m", "north_m"]].to_numpy() for rows in (mine, asked))
                assert np.abs(place[:, None] - other[None]).max(axis=2).min() >= tasks.BLOCK_GUARD_M - 1e-9
            else:
                seconds, other = (pd.DatetimeIndex(rows["time"]).as_unit("ns").asi8 / 1e9 for rows in (mine, asked))
                assert np.abs(seconds[:, None] - other[None]).min() > tasks.STRETCH_GUARD_S
        assert len(times) == len(set(times)) == 400  # each sample is asked for once
    assert folds > 12


def test_our_entrants_are_scored_from_what_they_write(place: Path, bench: tasks.Bench, tmp_path: Path) -> None:
    names = ["free_space", "constant", "log_distance", "kriging", "replay_drafted"]
    scores = published.enter(bench, ["halves", "sectors"], names, tmp_path)
    assert {task: sorted(rows) for task, rows in scores.items()} == dict.fromkeys(("halves", "sectors"), sorted(names))
    for task, name in [(task, name) for task, rows in scores.items() for name in rows]:
        given = pd.read_csv(tmp_path / f"{name}.csv", comment="#")
        both = bench.rows(task).merge(given[given["task"] == task], on=tasks.KEY)
        error = both["measured"] - both["level_db"]
        error = error - error.mean() if task == "sectors" else error
        assert len(both) == 400
        assert scores[task][name]["rmse_db"] == pytest.approx(float(np.sqrt(np.mean(error**2))), abs=1e-4)
        assert (both["sd_db"] > 0).all()
    # 35 dB per decade were made: the fitted slope beats 20 dB per decade, and both beat a constant
    order = sorted(("free_space", "constant", "log_distance"), key=lambda n: scores["halves"][n]["rmse_db"])
    assert order == ["log_distance", "free_space", "constant"]


def test_entrants_use_the_public_face_alone() -> None:
    tree = ast.parse((FOLDER / "entrants.py").read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert {name for name in modules if name.startswith("aerpaw_cmp")} == {"aerpaw_cmp"}
    used = {
        n.attr
        for n in ast.walk(tree)
        if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id == "ac"
    }
    assert {"Flight", "OrdinaryKriging", "Variogram", "channel_rank"} <= used <= set(aerpaw_cmp.__all__)


def test_template_has_no_level_of_a_test_flight(place: Path) -> None:
    out = place / "template.csv"
    data = ["--data", str(place / "logs"), "--manifest", str(place / "manifest.yaml")]
    assert published.main(["template", *data, "-o", str(out), "--task", "unseen"]) == 0
    table, known = pd.read_csv(out), pd.read_csv(place / "template_train.csv")
    assert len(table) == 400
    assert table["level_db"].isna().all()
    assert "measured" not in table
    assert set(known["flight"]) == {"known"}
    assert {"east_m", "tower_up_m", "heading_deg", "carrier_hz", "fold"} <= set(table.columns)


def _refused(place: Path, bench: tasks.Bench, frame: pd.DataFrame, head: str = "") -> str:
    with pytest.raises((UsageError, InputError)) as caught:
        published.score(bench, entry(place, frame, "bad", head), [])
    return str(caught.value)


def test_the_ten_lines_of_the_page_make_an_entry_that_is_scored(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Follow the README from the template to the scores, on simulated flights."""
    monkeypatch.chdir(tmp_path)
    data = ["--data", str(place / "logs"), "--manifest", str(place / "manifest.yaml")]
    assert published.main(["template", *data, "-o", "predictions.csv", "--task", "unseen"]) == 0
    page = (FOLDER / "README.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(compile(code, "README.md", "exec"), {"__name__": "page"})
    capsys.readouterr()
    assert published.main(["score", "mine.csv", *data, "--task", "unseen"]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]["unseen"]
    assert scores["rmse_db"] < 4.0  # the flights fall by 35 dB per decade, with a fade of 3 dB and noise of 2
    assert published.main(["score", "gone.csv", *data]) == 3
    assert "gone.csv: cannot be read" in capsys.readouterr().err
    assert published.main(["tasks", *data]) == 0
    assert json.loads(capsys.readouterr().out)["unseen"]["missing"] == ["absent: absent.csv of nobody/absent"]


def test_a_csv_of_the_referee_is_an_entry(place: Path, bench: tasks.Bench) -> None:
    """The same numbers as level at a time, as level in dBm at a position and as path loss, without task and flight."""
    table, frame = bench.rows("unseen"), guess(bench)
    expected = published.score(bench, entry(place, frame.drop(columns="sd_db")), ["unseen"])["unseen"]
    by_time = pd.DataFrame({"time_utc": table["time"], "tower": "T1", "level_dbm": frame["level_db"]})
    by_place = table[["east_m", "north_m", "tower"]].assign(height_m=table["up_m"], path_loss_db=-frame["level_db"])
    for name, given in (("time", by_time), ("place", by_place)):
        scores = published.score(bench, entry(place, given, name), [])
        assert scores["unseen"]["rmse_db"] == pytest.approx(expected["rmse_db"], abs=1e-9)
        # a loss has no common reference with the tasks that count levels as they are
        assert sorted(scores) == (["halves", "map", "sectors", "unseen"] if name == "time" else ["sectors", "unseen"])
    with pytest.raises(UsageError, match="200 of 400 rows have no prediction"):
        published.score(bench, entry(place, by_time.iloc[:200]), [])
    with pytest.raises(InputError, match="expected towers of the flight: T1"):
        published.score(bench, entry(place, by_time.assign(tower="LW9")), [])
    learned = f"# trained_on: {bench.manifest.files['asked'].sha256}\n"
    with pytest.raises(UsageError, match="a test flight"):
        published.score(bench, entry(place, by_time, "learned", learned), [])


def test_refusals_name_the_cause(place: Path, bench: tasks.Bench) -> None:
    good = guess(bench)
    asked = bench.manifest.files["asked"].sha256
    cases = {
        "1 rows stand twice": pd.concat([good, good.tail(1)]),
        "1 of 400 rows have no prediction": good.iloc[1:],
        "rise by": good.assign(level_db=-good["level_db"]),
        "are spread by": good.assign(level_db=10.0 ** (good["level_db"] / 10.0)),
        "unknown task 'other'": good.assign(task="other"),
        "no column 'time'": good.drop(columns="time"),
        "level_db 'loud'": good.assign(level_db=["loud", *good["level_db"].iloc[1:]]),
        "standard deviation of 0": good.assign(sd_db=0.0),
        "400 of 400 rows": good.assign(time="2025-06-01T00:00:00.000000Z" + good["time"]),
    }
    for words, frame in cases.items():
        assert words in _refused(place, bench, frame)
    assert "a test flight" in _refused(place, bench, good, f"# trained_on: {asked}\n")


def test_a_changed_file_is_told(place: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    shutil.copytree(place / "logs", logs)
    text = (place / "manifest.yaml").read_text().replace("path: known.csv", "path: known.mat")
    (tmp_path / "manifest.yaml").write_text(text)
    (logs / "renamed_0.csv").unlink()
    (logs / "known.mat").write_bytes(b"another content")
    with pytest.raises(InputError, match=hashlib.sha256(b"another content").hexdigest()):
        _ = tasks.Bench(logs, tmp_path / "manifest.yaml").places


def test_our_names_are_told_where_one_is_unknown(bench: tasks.Bench) -> None:
    with pytest.raises(UsageError, match="unknown entrant 'magic'"):
        published.enter(bench, [], ["magic"])
    with pytest.raises(UsageError, match="unknown task 'magic'"):
        published.enter(bench, ["magic"], [])


def test_the_manifest_is_whole(place: Path) -> None:
    manifest = tasks.Bench(place).manifest
    assert len(manifest.tasks) == 9
    used = {log["path"] for flight in manifest.flights.values() for log in flight["logs"]}
    assert used == set(manifest.files)
    for task in manifest.tasks.values():
        assert not set(task.train) & set(task.test)
        assert {*task.train, *task.test} <= set(manifest.flights)


@pytest.mark.field
def test_real_tasks_on_the_files_at_hand(tmp_path: Path) -> None:
    real = tasks.Bench(REAL)
    at_hand = [t for t in real.manifest.tasks if not real.skipped(t, training=True)]
    assert {"level_dataset12_heading", "level_dataset12_sector", "level_dataset12_map", "snr_aadm"} <= set(at_hand)
    scores = published.enter(real, ["level_dataset12_heading"], ["free_space", "boosted_trees"])[
        "level_dataset12_heading"
    ]
    # another heading, the same place and height: the RMSE of free space is 5.6 dB (field README)
    assert scores["free_space"]["rmse_db"] == pytest.approx(5.6, abs=0.2)
    assert scores["boosted_trees"]["rmse_db"] < scores["free_space"]["rmse_db"]


@pytest.mark.field
def test_ranks_by_replay_say_more_than_a_constant(tmp_path: Path) -> None:
    text = tasks.MANIFEST.read_text()
    task = "tasks:\n  ranks: {title: Ranks, kind: rank, train: [nr_flight1], test: [nr_flight3]}\n"
    manifest = tmp_path / "manifest.yaml"
    manifest.write_text(text[: text.index("tasks:\n")] + task)
    real = tasks.Bench(REAL, manifest)
    scores = published.enter(real, [], list(entrants.RANK))["ranks"]
    # a constant forecast that says one rank has no kappa to speak of, and its log score is that of the constant
    assert scores["constant"]["log_score"] == pytest.approx(scores["constant"]["constant_log_score"], abs=1e-3)
    assert scores["replay"]["log_score"] < scores["constant"]["log_score"]


# --- intervals -----------------------------------------------------------------------------------------------------


def test_intervals_are_those_of_blocks_of_twenty_seconds() -> None:
    assert (block_of(LONG), block_of(SHORT)) == (10, 13)  # 20 s at 2 s and at 1.5 s a sample
    assert block_of(dataclasses.replace(LONG, time_s=np.zeros(60))) == 1
    assert block_of(dataclasses.replace(LONG, time_s=np.arange(60) * 0.1)) == 60
    total = np.zeros(2000)
    for series, block, own in ((LONG, 10, True), (SHORT, 13, True)):
        error = series.error_db
        drawn = bootstrap_means(np.column_stack([error, error**2]), block, 20240715 + (series is SHORT))
        total += np.sqrt(drawn[:, 1] - own * drawn[:, 0] ** 2) / 2
    np.testing.assert_allclose(rmse_replicates([LONG, SHORT]), total)
    free = dataclasses.replace(LONG, own_offset=False)
    error = free.error_db
    drawn = bootstrap_means(error[:, None] ** 2, 10, 20240715)[:, 0]
    np.testing.assert_allclose(rmse_replicates([free]), np.sqrt(drawn))
    worse = dataclasses.replace(LONG, level_db=LONG.measured_db + 2.0 * (LONG.level_db - LONG.measured_db))
    ends = intervals([worse], {"base": [LONG]})
    assert ends["rmse_ci95_db"] == pytest.approx(np.quantile(2.0 * rmse_replicates([LONG]), [0.025, 0.975]))
    assert ends["difference_to_base_ci95_db"] == pytest.approx(np.quantile(rmse_replicates([LONG]), [0.025, 0.975]))


# --- standards -----------------------------------------------------------------------------------------------------

NEAR, FAR = np.array([200.0]), np.array([400.0])
HIGH = np.array([50.0])


def test_slopes_are_those_of_the_tables() -> None:
    """Decibels per decade: 22.9 (P.1411), 22 (UMa-AV), 23.9 - 1.8 log10 50 (RMa-AV)."""
    decade = np.log10(FAR / NEAR)
    assert (entrants.p1411_loss_db(FAR, 3.3e9) - entrants.p1411_loss_db(NEAR, 3.3e9)) / decade == pytest.approx(22.9)
    for scenario, slope in (("UMa-AV", 22.0), ("RMa-AV", 23.9 - 1.8 * np.log10(50.0))):
        far, near = (entrants.tr36777_loss_db(scenario, d, HIGH, 3.3e9) for d in (FAR, NEAR))
        assert (far - near) / decade == pytest.approx(slope)


def test_values_by_hand_lie_near_free_space() -> None:
    """At 200 m and 3.3 GHz, free space loses 88.8 dB, and each line-of-sight model is within 4 dB of it."""
    free = 20.0 * np.log10(4.0 * np.pi * 200.0 * 3.3e9 / 299_792_458.0)
    assert free == pytest.approx(88.83, abs=0.01)
    assert entrants.p1411_loss_db(NEAR, 3.3e9) == pytest.approx(91.46, abs=0.01)  # 52.69 + 28.6 + 10.16
    assert entrants.tr36777_loss_db("UMa-AV", NEAR, HIGH, 3.3e9) == pytest.approx(88.99, abs=0.01)  # 28 + 50.62 + 10.37
    for loss in (entrants.p1411_loss_db(NEAR, 3.3e9), entrants.tr36777_loss_db("RMa-AV", NEAR, HIGH, 3.3e9)):
        assert abs(loss - free) < 4.0


def test_low_terminals_count_as_ten_metres() -> None:
    low, ten = (entrants.tr36777_loss_db("RMa-AV", NEAR, np.array([h]), 3.3e9) for h in (2.0, 10.0))
    assert low == ten


@pytest.mark.parametrize(("n", "length", "columns"), [(97, 10, 2), (97, 1, 3), (97, 10, 400), (12, 12, 1), (1, 1, 2)])
def test_resamples_have_the_moments_of_the_circular_block_bootstrap(n, length, columns):
    rng = np.random.default_rng(3)
    data = rng.normal(size=(n, columns)) + 5.0
    drawn = bootstrap_means(data, length, 7)
    np.testing.assert_allclose(drawn.mean(axis=0), data.mean(axis=0), atol=0.05)
    # exact variance: independent whole blocks and one shorter one
    full_blocks, last = -(-n // length) - 1, n - (-(-n // length) - 1) * length
    ring = np.concatenate([data, data])

    def sums(size):
        return np.array([ring[s : s + size].sum(axis=0) for s in range(n)])

    expected = (full_blocks * sums(length).var(axis=0) + sums(last).var(axis=0)) / n**2
    np.testing.assert_allclose(drawn.var(axis=0).mean(), expected.mean(), rtol=0.08, atol=1e-12)
