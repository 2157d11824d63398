"""The public face: every name of ``__all__`` is there, is documented, and does what docs/api.md says."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest

import aerpaw_cmp as ac
from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import AerpawCmpError

pytestmark = pytest.mark.usefixtures("few_pictures")

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "sample_logs"


def test_every_public_name_exists_has_a_docstring_and_stands_in_the_page() -> None:
    page = (ROOT / "docs" / "api.md").read_text()
    for name in ac.__all__:
        value = getattr(ac, name)
        assert name == "__version__" or inspect.getdoc(value), name
        assert f"`{name}" in page or name == "__version__", f"docs/api.md does not name {name}"
    assert set(ac.__all__) - {"__version__"} == set(ac._HOME)
    assert set(dir(ac)) == set(ac.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ac.nothing


def test_the_stub_names_every_public_name_from_its_home() -> None:
    """Type checkers read ``__init__.pyi`` alone: without it every public name would be ``Any``."""
    stub = (ROOT / "aerpaw_cmp" / "__init__.pyi").read_text()
    lines = re.findall(r"^from aerpaw_cmp\.([\w.]+) import (\w+) as \2$", stub, re.MULTILINE)
    assert {name: home for home, name in lines} == ac._HOME


def test_using_one_name_loads_only_its_room() -> None:
    code = (
        "import sys, aerpaw_cmp; aerpaw_cmp.channel_rank; sys.exit('pandas' in sys.modules or 'sionna' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


@pytest.mark.parametrize("name", ["propagation.replay", "propagation.check.audit", "logs.ingest", "compare.rank"])
def test_no_function_hides_a_module(name: str) -> None:
    module = importlib.import_module(f"aerpaw_cmp.{name}")
    package, _, last = name.rpartition(".")
    assert inspect.ismodule(getattr(importlib.import_module(f"aerpaw_cmp.{package}"), last))
    assert inspect.ismodule(module)


def test_read_gives_frames_by_stream_with_their_account() -> None:
    logs = ac.read(SAMPLE / "UAV", timezone="America/New_York")
    frames = [frame for frame in logs.values() if frame.attrs["kind"] == "telemetry"]
    assert frames
    assert {"time", "latitude_deg", "altitude_m"} <= set(frames[0].columns)
    lines = sum(file["lines"] for file in logs.account["files"])
    assert lines == sum(file.result.lines for file in logs.files)
    assert "<table>" in logs._repr_html_()
    assert f"{len(frames[0])} records" in repr(logs)


def test_read_takes_patterns_lists_and_zones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(SAMPLE.parent))
    log = next((SAMPLE / "UAV").glob("*vehicleOut*"))
    expected = ac.read(log, timezone="America/New_York")["vehicle"]
    assert str(expected.time.dt.tz) == "UTC"
    for source in (f"{SAMPLE}/UAV/*vehicleOut*", f"~/{SAMPLE.name}/UAV/*vehicleOut*", [log], iter([str(log)])):
        pd.testing.assert_frame_equal(ac.read(source, timezone=ZoneInfo("America/New_York"))["vehicle"], expected)
    with pytest.raises(Exception, match="no file matches the pattern"):
        ac.read(f"{SAMPLE}/*.nothing")


def test_logs_are_selected_written_and_opened_again_as_a_flight(tmp_path: Path) -> None:
    logs = ac.read([SAMPLE / "UAV", SAMPLE / "LW1"], timezone="America/New_York")
    assert {frame.attrs["kind"] for frame in logs.select(kind="rss").values()} == {"rss"}
    assert set(logs.select(kind="rss", node="nowhere")) == set()
    named = ac.read(f"{SAMPLE}/LW*/*.txt", timezone="America/New_York").select(kind="rss", node="LW1")
    assert [Path(name).parent.name for name in named] == ["LW1", "LW1"]
    logs.write(tmp_path / "flight.h5")
    again = ac.read(tmp_path / "flight.h5")
    assert set(again) == set(logs)
    for name, frame in logs.items():
        pd.testing.assert_frame_equal(again[name], frame)
    flight = ac.open_flight(tmp_path / "flight.h5")
    records = {frame.attrs["kind"]: len(frame) for frame in logs.values()}
    assert len(flight.rank) == records["rank"]
    assert str(flight.rss.time.dt.tz) == "UTC"
    assert flight.plot().get_xlabel() == "East [m]"
    assert "LW1" in flight.site.towers
    with pytest.raises(Exception, match="an unchanged flight file"):
        flight.report(tmp_path / "report")


def test_streams_of_one_name_keep_apart() -> None:
    paths = sorted((SAMPLE / "LW1").iterdir()) + sorted((SAMPLE / "LW2").iterdir())
    logs = ac.read(paths, timezone="America/New_York")
    assert len(logs) == sum(len(file.result.streams) for file in logs.files)


@pytest.fixture(scope="module")
def flight() -> ac.Flight:
    return ac.open_flight(SAMPLE / "flight.yaml", overrides={"rss.lag": "off"})


def test_a_flight_gives_its_series_as_frames(flight: ac.Flight) -> None:
    assert set(flight.rss.tower) <= set(flight.site.towers)
    assert len(flight.rss) == sum(len(series.time) for series in flight.data.rss)
    assert len(flight.rank) == sum(len(series.time) for series in flight.data.rank)
    assert flight.track.time.is_monotonic_increasing
    assert flight.track[["east_m", "north_m", "up_m"]].notna().all(axis=None)
    assert "samples" in flight._repr_html_()
    assert "RSS series" in repr(flight)


def test_a_replayed_flight_has_levels_matrices_and_paths_that_agree(flight: ac.Flight) -> None:
    replayed = flight.replay(max_depth=0, foliage="none")
    key = next(key for key in replayed.series if key[1] != "rank")
    level, h = replayed.rss_dbm[key], replayed.h[key]
    series = replayed.series[key]
    power = series.link.transmit_power_dbm + 10 * np.log10((np.abs(h) ** 2).mean(axis=(1, 2)))
    known = np.isfinite(level[series.valid])
    assert level[series.valid][known] == pytest.approx(power[known], abs=1e-9)
    assert replayed.paths[key].depth.max() == 0
    data = replayed.to_xarray()["/".join(key)]
    assert data.sizes["time"] == series.valid.sum()
    assert {"time", "tower", "rx", "tx", "east_m"} <= set(data.coords)
    assert data.h.sel(tower=key[0], time=slice(None, data.time[9])).values.tobytes() == h[:10].tobytes()
    compared = replayed.compare()
    levels = compared.to_xarray()["/".join(key)]
    residual = levels.residual_db
    assert float(abs(levels.calibrated_db - levels.simulated_dbm - residual).max()) < 1e-9
    score = next(fit for fit in compared.result.rss if (fit.tower, fit.channel) == key).score
    assert float(np.sqrt(np.nanmean(residual**2))) == pytest.approx(score.rmse_db)
    assert len(compared.plot().lines) == 2 * len(compared.result.rss)
    table = compared.to_frame()
    assert len(table) == len(flight.data.rss)
    assert {"rmse_db", "free_space_rmse_db", "two_ray_rmse_db"} <= set(table.columns)
    with pytest.raises(Exception, match="did you mean 'max_depth'"):
        flight.replay(max_deph=1)
    with pytest.raises(Exception, match="an unchanged flight file"):
        flight.report("nowhere")


def test_trace_takes_plain_positions_and_equals_free_space_where_nothing_reflects() -> None:
    from aerpaw_cmp.propagation.geometry import single_element

    link = ac.Link(3.4e9, {"LW1": single_element()}, single_element(), transmit_power_dbm=40.0)
    site = ac.load_site("lake_wheeler")
    traced = ac.trace(site, link, site.towers["LW1"].position_m + np.array([[100.0, 0.0, 60.0]]), max_depth=0)
    metres = np.hypot(100.0, 60.0)
    friis = 40.0 - 20 * np.log10(4 * np.pi * metres * 3.4e9 / 299_792_458.0)
    assert traced.rss_dbm[0, 0] == pytest.approx(friis, abs=1e-9)
    data = traced.to_xarray()
    assert data.rss_dbm.sel(tower="LW1").item() == traced.rss_dbm[0, 0]
    assert data.h.sel(pose=0, rx=0, tx=0, tower="LW1").item() == traced.h.item()
    assert "1 pose, towers LW1" in repr(traced)
    with pytest.raises(Exception, match="positions"):
        ac.trace(site, link, [[1.0, 2.0]])


def test_variogram_finds_the_correlation_it_was_given() -> None:
    """Fields with correlation exp(-d / 100 m), drawn exactly, each standardised over the area.

    Taking off the mean turns the covariance into J Phi J (J the centring matrix): its means per bin are expected.
    """
    rng = np.random.default_rng(5)
    east, north = np.meshgrid(np.arange(20) * 30.0, np.arange(20) * 30.0)
    points = np.column_stack([east.ravel(), north.ravel()])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    correlation = np.exp(-distance / 100.0)
    fields = np.linalg.cholesky(correlation + 1e-9 * np.eye(400)) @ rng.standard_normal((400, 200))
    centring = np.eye(400) - 1.0 / 400
    centred = centring @ correlation @ centring
    variogram = ac.Variogram(maximum_m=300.0).fit(points, fields)
    bins = np.floor(distance / 30.0 + 0.5)
    expected = [centred[bins == n].mean() / np.trace(centred) * 400 for n in range(1, 11)]
    assert variogram.binned_.correlation[1:] == pytest.approx(expected, abs=0.03)
    at = variogram.binned_.mean_distance_m[1:7]  # beyond them the correlation is negative, which no such curve is
    assert variogram(at) == pytest.approx(variogram.binned_.correlation[1:7], abs=0.06)
    estimate, _ = ac.OrdinaryKriging(variogram, radius_m=500.0).fit(points, fields[:, 0]).predict(points[:5])
    assert estimate == pytest.approx(fields[:5, 0], abs=1e-6)


def test_errors_of_python_name_its_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.csv").write_text("Time (s),Power (dBm)\n" + "".join(f"{i},{-80 - i}\n" for i in range(30)))
    (tmp_path / "lost.yaml").write_text((SAMPLE / "flight.yaml").read_text())
    flight = ac.open_flight(SAMPLE / "flight.yaml")
    columns = {"time": "Time (s)", "rss_db": "Power (dBm)"}
    for call, words in (
        (lambda: ac.read(SAMPLE / "UAV"), "the key 'timezone:' or timezone=, e.g."),
        (lambda: ac.read(tmp_path / "mine.csv"), f"columns={columns}"),
        (lambda: ac.open_flight(tmp_path / "lost.yaml"), "a wrong path or a wrong logs_root="),
        (lambda: flight.report(tmp_path / "out", audit="x"), "audit='x'"),
        (lambda: flight.report(tmp_path), "expected a new or empty folder, because all content"),
        (lambda: ac.OrdinaryKriging(np.exp).predict([[0.0, 0.0]]), "OrdinaryKriging.predict before fit()"),
        (lambda: ac.Variogram()(np.arange(3.0)), "Variogram.__call__ before fit()"),
    ):
        with pytest.raises(AerpawCmpError) as caught:
            call()
        assert words in str(caught.value)
        assert not re.search(r"--|\s-o\b", str(caught.value))
    logs = ac.read(tmp_path / "mine.csv", columns=columns, kind="rss", time_origin="2025-06-01T14:00:00Z")
    assert len(logs["rss"]) == 30
    assert main(["ingest", str(SAMPLE / "UAV")]) == 2
    assert "--timezone" in capsys.readouterr().err


def test_every_public_function_names_itself_and_an_argument_that_it_does_not_know(flight: ac.Flight) -> None:
    replayed = flight.replay(max_depth=0, foliage="none")
    things = [
        ac.Flight(flight.path, flight.data),
        replayed,
        replayed.compare(),
        ac.read(SAMPLE / "UAV", timezone="America/New_York"),
        flight.site,
    ]
    things += [ac.Variogram(), ac.OrdinaryKriging(np.exp)]
    first = {"read": (SAMPLE / "UAV",), "report": ("out",)}
    calls = {name: getattr(ac, name) for name in ac.__all__ if callable(getattr(ac, name))}
    for thing in things:
        names = [name for name, _ in inspect.getmembers(type(thing), inspect.isfunction) if name[0] != "_"]
        calls |= {f"{type(thing).__name__}.{name}": getattr(thing, name) for name in names}
    del calls["Logs.select"]  # any attribute of a stream may be asked for
    assert len(calls) > 35
    for name, call in calls.items():
        words = r"no key 'unheard'" if name in ("Flight.replay", "Flight.compare") else r"(\w+)\(\) .*'unheard'"
        with pytest.raises((AerpawCmpError, TypeError), match=words) as caught:
            call(*first.get(name.split(".")[-1], ()), unheard=1)
        assert "Options" not in str(caught.value), name
