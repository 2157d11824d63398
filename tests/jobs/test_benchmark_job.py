"""The public benchmark on made-up flights: splits, entries, scores by a second way, refusals."""

import csv
import gzip
import hashlib
import json
import math
import re
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import InputError, OutputError, UsageError
from aerpaw_cmp.jobs.benchmarks import benchmark, benchmark_run, entrants
from tests.real_logs import REAL

TOWER = np.array([0.0, 0.0, 10.0])
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
def bench(place: Path) -> benchmark.Bench:
    return benchmark_run.open_bench(place / "logs", place / "manifest.yaml")


def entry(place: Path, frame: pd.DataFrame, name: str = "mine", head: str = "") -> Path:
    path = place / f"{name}.csv"
    path.write_text(head + frame.to_csv(index=False))
    return path


def guess(bench: benchmark.Bench, task: str = "unseen", **changes: object) -> pd.DataFrame:
    """What a stranger hands in after ten lines of NumPy."""
    table = benchmark.truth(bench, task)
    distance = np.sqrt(sum((table[f"{a}_m"] - table[f"tower_{a}_m"]) ** 2 for a in ("east", "north", "up")))
    level = -15.0 - 25.0 * np.log10(distance)
    return table[benchmark.KEY].assign(**{"level_db": level, "sd_db": 3.0, **changes})


def test_files_are_known_by_content(bench: benchmark.Bench) -> None:
    assert sorted(bench.places) == ["asked", "known"]
    assert bench.skipped("unseen", training=True) == ["absent: absent.csv of nobody/absent"]
    assert bench.tests("unseen") == ["asked"]


def test_scores_by_plain_loops(place: Path, bench: benchmark.Bench) -> None:
    frame = guess(bench)
    result = benchmark_run.score_predictions(
        entry(place, frame), place / "logs", manifest=place / "manifest.yaml", leaderboard=place / "board.json"
    )
    score = result.scores["unseen"]["mine"]
    truth = benchmark.truth(bench, "unseen")
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
    rows = json.loads((place / "board.json").read_text())
    assert [r["scores"]["unseen"]["n"] for r in rows] == [400.0]
    assert set(rows[0]["test_files_sha256"]) == {"asked"}


def _crps(error: float, sd: float) -> float:
    """By its definition: the integral of the squared difference of the distributions."""
    x = np.linspace(-60.0, 60.0, 240_001)
    forecast = 0.5 * (1.0 + np.vectorize(math.erf)(x[::40] / sd / math.sqrt(2.0)))
    return float(np.trapezoid((np.interp(x, x[::40], forecast) - (x >= error)) ** 2, x)) if abs(error) < 60 else 0.0


def test_nothing_of_a_fold_is_known(bench: benchmark.Bench) -> None:
    folds = 0
    for task, own in (("sectors", False), ("map", True), ("halves", True)):
        rows = []
        for question in benchmark.questions(bench, task, "asked"):
            folds += 1
            rows.append(question.rows[0])
            asked = question.targets[0].samples
            for known in question.train:
                s = known.samples
                if task == "sectors":
                    a, b = (np.degrees(np.arctan2(x.at_tower[:, 0], x.at_tower[:, 1])) for x in (s, asked))
                    away = np.abs((a[:, None] - b[None] + 180.0) % 360.0 - 180.0)
                    assert away.min() > benchmark.SECTOR_GUARD_DEG - 1e-9
                elif task == "map" and s.flight == "asked":
                    apart = np.abs(s.position_m[:, None, :2] - asked.position_m[None, :, :2]).max(axis=2)
                    assert apart.min() >= benchmark.BLOCK_GUARD_M - 1e-9
                elif task == "halves":
                    assert np.abs(s.time_s[:, None] - asked.time_s[None]).min() > benchmark.STRETCH_GUARD_S
            if own:
                assert any(k.samples.flight == "asked" for k in question.train)
            else:
                assert all(k.samples.flight == "known" for k in question.train)
        assert sorted(np.concatenate(rows).tolist()) == list(range(400))  # each sample is asked for once
    assert folds > 12


def test_our_table_is_remade_from_its_csvs(place: Path) -> None:
    out = place / "out"
    code = main(
        ["benchmark", "--data", str(place / "logs"), "--manifest", str(place / "manifest.yaml"), "-o", str(out), "-q"]
        + [x for name in ("free_space", "constant", "log_distance", "kriging", "two_ray") for x in ("--entrant", name)]
        + [x for name in ("map", "halves", "sectors") for x in ("--task", name)]
    )
    assert code == 0
    with (out / "scores.csv").open() as stream:
        rows = {(r["task"], r["entrant"]): r for r in csv.DictReader(stream)}
    assert len(rows) == 15
    for (task, name), row in rows.items():
        given = pd.read_csv(out / "predictions" / f"{name}.csv", comment="#")
        truth = benchmark.truth(benchmark_run.open_bench(place / "logs", place / "manifest.yaml"), task)
        both = truth.merge(given[given["task"] == task], on=benchmark.KEY)
        error = both["measured"] - both["level_db"]
        error = error - error.mean() if task == "sectors" else error
        assert len(both) == 400
        assert float(row["rmse_db"]) == pytest.approx(float(np.sqrt(np.mean(error**2))), abs=1e-9)
    # 35 dB per decade were made: the fitted slope beats 20 dB per decade, and both beat a constant
    order = sorted(("free_space", "constant", "log_distance"), key=lambda n: float(rows["halves", n]["rmse_db"]))
    assert order == ["log_distance", "free_space", "constant"]
    page = (out / "benchmark.html").read_text()
    assert "nobody/absent" in page
    assert "Lowest RMSE" in page


def test_template_has_no_level_of_a_test_flight(place: Path) -> None:
    out = place / "template.csv"
    arguments = ["benchmark", "template", "--data", str(place / "logs"), "--manifest", str(place / "manifest.yaml")]
    assert main([*arguments, "-o", str(out), "-q", "--task", "unseen"]) == 0
    table, known = pd.read_csv(out), pd.read_csv(place / "template_train.csv")
    assert len(table) == 400
    assert table["level_db"].isna().all()
    assert "measured" not in table
    assert set(known["flight"]) == {"known"}
    assert {"east_m", "tower_up_m", "yaw_deg", "body_forward", "carrier_hz", "fold"} <= set(table.columns)


def _refused(place: Path, frame: pd.DataFrame, head: str = "") -> str:
    with pytest.raises((UsageError, InputError)) as caught:
        benchmark_run.score_predictions(
            entry(place, frame, "bad", head), place / "logs", manifest=place / "manifest.yaml"
        )
    return str(caught.value)


def test_the_ten_lines_of_the_page_make_an_entry_that_is_scored(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What docs/benchmark.md tells a stranger, from the template to the row, on made-up flights."""
    monkeypatch.chdir(tmp_path)
    data = ["--data", str(place / "logs"), "--manifest", str(place / "manifest.yaml")]
    assert main(["benchmark", "template", *data, "-o", "predictions.csv", "--task", "unseen"]) == 0
    page = (Path(__file__).parents[2] / "docs" / "benchmark.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    exec(compile(code, "docs/benchmark.md", "exec"), {"__name__": "page"})
    capsys.readouterr()
    line = ["benchmark", "score", "mine.csv", *data, "--task", "unseen", "--leaderboard", "leaderboard.json", "--json"]
    assert main(line) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]["unseen"]
    assert list(scores) == ["mine"]
    assert scores["mine"]["rmse_db"] < 4.0  # the flights fall by 35 dB per decade, with a fade of 3 dB and noise of 2
    assert len(json.loads(Path("leaderboard.json").read_text())) == 1


def test_refusals_name_the_cause(place: Path, bench: benchmark.Bench) -> None:
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
        assert words in _refused(place, frame)
    assert "a test flight" in _refused(place, good, f"# trained_on: {asked}\n")


def test_a_changed_file_is_told(place: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    shutil.copytree(place / "logs", logs)
    text = (place / "manifest.yaml").read_text().replace("path: known.csv", "path: known.mat")
    (tmp_path / "manifest.yaml").write_text(text)
    (logs / "renamed_0.csv").unlink()
    (logs / "known.mat").write_bytes(b"another content")
    with pytest.raises(InputError, match=hashlib.sha256(b"another content").hexdigest()):
        _ = benchmark_run.open_bench(logs, tmp_path / "manifest.yaml").places


def test_our_names_are_told_where_one_is_unknown(place: Path) -> None:
    with pytest.raises(UsageError, match="unknown entrant 'magic'"):
        benchmark_run.run_benchmark(place / "logs", place / "x", only=["magic"], manifest=place / "manifest.yaml")
    assert "learned_residual" in entrants.LEVEL


def test_packaged_manifest_is_whole() -> None:
    manifest = benchmark.load_manifest()
    assert len(manifest.tasks) == 9
    used = {log["path"] for flight in manifest.flights.values() for log in flight["logs"]}
    assert used == set(manifest.files)
    for task in manifest.tasks.values():
        assert not set(task.train) & set(task.test)
        assert {*task.train, *task.test} <= set(manifest.flights)


@pytest.mark.field
def test_real_tasks_on_the_files_at_hand() -> None:
    real = benchmark_run.open_bench(REAL)
    at_hand = [t for t in real.manifest.tasks if not real.skipped(t, training=True)]
    assert {"level_dataset12_heading", "level_dataset12_sector", "level_dataset12_map", "snr_aadm"} <= set(at_hand)
    frame = entrants.predict(real, "level_dataset12_heading", "learned")
    assert frame is not None
    score = benchmark.score_task(real, "level_dataset12_heading", benchmark.Entry(frame, {}, ""), {})
    # another heading, the same place and height: free space leaves 5.6 dB (field README), a repeat of the flight 3.0
    assert 3.0 < score["rmse_db"] < 4.5
    train, test = real.ranks("nr_flight1"), real.ranks("nr_flight3")
    assert [len(train), len(test)] == [1, 1]
    p = entrants.RANK["constant"](real, ["nr_flight1"], "nr_flight3")[0]
    assert p.shape == (len(test[0].rank), 4)
    assert np.allclose(p.sum(axis=1), 1.0)


RANK_TASK = """
  ranks: {title: Ranks, kind: rank, train: [nr_flight1], test: [nr_flight3]}
"""


@pytest.mark.field
def test_a_rank_task_reaches_the_page(tmp_path: Path) -> None:
    packaged = (Path(benchmark.__file__).parent / "benchmark.yaml").read_text()
    manifest = tmp_path / "manifest.yaml"
    manifest.write_text(packaged[: packaged.index("tasks:")] + "tasks:" + RANK_TASK)
    result = benchmark_run.run_benchmark(REAL, tmp_path / "out", manifest=manifest, only=["constant"])
    score = result.scores["ranks"]["constant"]
    # a constant forecast that says one rank has no kappa to speak of, and its log score is that of the constant
    assert score["log_score"] == pytest.approx(score["constant_log_score"], abs=1e-3)
    assert "Ranks" in (tmp_path / "out" / "benchmark.html").read_text()


class _Published(BaseHTTPRequestHandler):
    """A server that cuts the first answer short."""

    content = b"published " * 5000
    asked: list[str] = []  # noqa: RUF012

    def do_GET(self) -> None:
        self.asked.append(self.path)
        self.send_response(200)
        self.send_header("Content-Length", str(len(self.content)))
        self.end_headers()
        self.wfile.write(self.content[: len(self.content) // 2] if len(self.asked) == 1 else self.content)

    def log_message(self, *_: object) -> None:
        pass


def test_a_cut_download_leaves_nothing_and_a_whole_one_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = hashlib.sha256(_Published.content).hexdigest()
    for name, value in (("good", digest), ("changed", "a" * 64)):
        (tmp_path / f"{name}.yaml").write_text(
            f"version: 1\nflights: {{}}\ntasks: {{}}\nfiles:\n  log: {{repository: a/b, path: log.csv, bytes: "
            f"{len(_Published.content)}, sha256: {value}, licence: CC0-1.0}}\n"
        )
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Published)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        address = f"http://127.0.0.1:{server.server_port}/log.csv"
        monkeypatch.setattr(benchmark.FileEntry, "url", property(lambda _: address))
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        with pytest.raises((OutputError, InputError), match=r"could not be fetched|was cut"):
            benchmark_run.fetch(tmp_path / "logs", manifest=tmp_path / "good.yaml")
        assert not list((tmp_path / "logs").iterdir())
        (made,) = benchmark_run.fetch(tmp_path / "logs", manifest=tmp_path / "good.yaml")
        assert made.read_bytes() == _Published.content
        assert benchmark_run.fetch(tmp_path / "logs", manifest=tmp_path / "good.yaml") == []
        with pytest.raises(InputError, match="changed the file"):
            benchmark_run.fetch(tmp_path / "other", manifest=tmp_path / "changed.yaml")
        assert not list((tmp_path / "other").iterdir())
    finally:
        server.shutdown()
        server.server_close()


def test_a_template_without_a_flight_names_a_file_that_lacks(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    with pytest.raises(InputError, match=r"no test flight is at hand.* fetch"):
        benchmark_run.write_template(tmp_path / "logs", tmp_path / "p.csv")
    assert not list(tmp_path.glob("*.csv"))
