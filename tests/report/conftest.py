"""A flight that never was: free space and one ground reflection, seeded noise, every part of a report filled."""

import dataclasses
import itertools

import numpy as np
import pytest
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.compare.level import ChannelDifference
from aerpaw_cmp.compare.result import AuditResult, EngineResult, PairResult, RankResult, RssResult
from aerpaw_cmp.compare.verdict import flight_verdict
from aerpaw_cmp.logs.records import RejectedLine
from aerpaw_cmp.maps.variogram import BiExponential, BinnedCorrelation
from aerpaw_cmp.report.flight_data import DrawnPoint, DrawnTrack, InputFile, ReportData
from aerpaw_cmp.report.maps import Layer, MapError, MapsData, PaperRow, RankMap, RssMap
from aerpaw_cmp.site.site import Building, Forest, Geofence, Site, Tower, Trees
from benchmarks.fabricated import rank_result, rss_result

WAVELENGTH = 299_792_458.0 / 3.3e9


def make_site() -> Site:
    frame = SiteFrame(35.7275, -78.6960)
    towers = {}
    places = [(0.0, 0.0), (-130.0, 420.0), (380.0, -560.0), (-420.0, -700.0), (430.0, 830.0)]
    for name, (east, north) in zip(("LW1", "LW2", "LW3", "LW4", "LW5"), places, strict=True):
        lat, lon = frame.to_geographic(east, north)
        towers[name] = Tower(name, float(lat), float(lon), east, north)
    rng, n = np.random.default_rng(3), 400
    east, north = rng.uniform(150, 420, n), rng.uniform(150, 420, n)
    trees = Trees(east, north, *(np.full(n, value) for value in (0.0, 20.0, 10.0, 4.0, 0.4)))
    return Site(
        "Lake Wheeler (made for a test)",
        frame,
        towers,
        buildings=(
            Building("barn", box(-60, 20, -30, 45), 8.0),
            Building("house", Polygon([(60, -80), (85, -70), (80, -50), (55, -60)]), 6.0),
        ),
        forests=(
            Forest("wood", box(150, 150, 420, 420)),
            Forest("edge", Polygon([(-480, -300), (-300, -320), (-280, -100), (-470, -60)])),
        ),
        trees=trees,
        geofences=(Geofence("fence", box(-250, -120, 250, 330)),),
        credit="(c) mapmakers",
        notes=("Tower heights are 10 m.",),
    )


def make_track(n: int = 6000) -> DrawnTrack:
    s = np.linspace(0.0, 1.0, n)
    legs = 7
    phase = s * legs
    east = -180 + 360 * np.abs(2 * (phase / 2 - np.floor(phase / 2 + 0.5)))
    north = -80 + 360 * s
    up = 40.0 * np.clip(np.minimum(s / 0.08, (1 - s) / 0.08), 0.0125, 1)
    time = np.datetime64("2024-07-15T17:02:11", "ns") + (s * 950e9).astype("timedelta64[ns]")
    return DrawnTrack(time=time, position_m=np.column_stack([east, north, up]))


def make_rss(site: Site, track: DrawnTrack, tower: str, channel: str, seed: int) -> RssResult:
    rng = np.random.default_rng(seed)
    position, (east, north, up) = track.position_m, track.position_m.T
    t = site.towers[tower].position_m
    d = np.linalg.norm(position - t, axis=1)
    mirrored = np.linalg.norm(position - t * [1, 1, -1], axis=1)
    free = 40 + 20 * np.log10(WAVELENGTH / (4 * np.pi * d))
    waves = (np.exp(-2j * np.pi * way / WAVELENGTH) / way for way in (d, mirrored))
    two_ray = 40 + 20 * np.log10(WAVELENGTH / (4 * np.pi) * np.abs(next(waves) - 0.6 * next(waves)))
    azimuth = np.degrees(np.arctan2(north - t[1], east - t[0]))
    simulated = two_ray - 3.0 * np.cos(np.radians(azimuth - 40)) ** 2
    truth = (
        simulated + np.convolve(rng.normal(0, 9.0, len(d)), np.ones(25) / 25, mode="same") + rng.normal(0, 2.0, len(d))
    )
    measured = np.round(truth - 42.13, 1)
    blocked = (up < 12) & (d > 300) if tower != "LW1" else np.zeros(len(d), dtype=bool)
    simulated = np.where(blocked, np.nan, simulated)
    silent = (np.arange(len(d)) > 5900) & (tower == "LW4")
    measured = np.where(silent, np.nan, measured)
    levels = {"measured": measured, "simulated": simulated, "free_space": free, "two_ray": two_ray}
    return rss_result(
        tower, channel, track.time, position, levels, line_of_sight=np.where(blocked, 0.0, 1.0),
        geometry={"distance_m": d, "azimuth_deg": azimuth, "elevation_deg": np.degrees(np.arcsin((up - t[2]) / d)), "altitude_m": up},
    )  # fmt: skip


def make_rank(site: Site, track: DrawnTrack) -> RankResult:
    pick = slice(0, None, 6)
    (east, north, up), time = track.position_m[pick].T, track.time[pick]
    rng = np.random.default_rng(11)
    d = np.hypot(east, north) + 20
    slow = np.convolve(rng.normal(0, 6, len(d)), np.ones(12) / 12, mode="same")
    ratio = np.stack([-8 - 0.02 * d + slow, -22 - 0.06 * d + slow, -40 - 0.1 * d + slow], axis=1)
    measured = 1.0 + (ratio + rng.normal(0, 3, ratio.shape) > -24).sum(axis=1)
    measured[40:55] = np.nan
    h = np.zeros((len(d), 4, 4), dtype=complex)
    h[:, range(4), range(4)] = 10 ** (np.column_stack([np.zeros(len(d)), ratio]) / 20)
    h[up < 3] = 0
    return rank_result("LW1", time, np.column_stack([east, north, up]), measured, h, sinr_db=18 + slow)


def make_report() -> ReportData:
    site, track = make_site(), make_track()
    waypoints = tuple(
        DrawnPoint(label=c, time=track.time[i], east_m=track.position_m[i, 0], north_m=track.position_m[i, 1])
        for c, i in zip("ABCDEF", (480, 1700, 2560, 3420, 4280, 5500), strict=True)
    )
    rss = tuple(
        make_rss(site, track, tower, channel, seed)
        for seed, (tower, channel) in enumerate((("LW1", "USRP1"), ("LW1", "USRP2"), ("LW4", "USRP1")))
    )
    difference = rss[0].calibrated_db - rss[1].calibrated_db
    parted = ChannelDifference(
        n=len(difference), mean_db=0.0, std_db=1.0, correlation=0.9,
        spans=list(rss[0].spans),
    )  # fmt: skip
    pair = PairResult(
        tower="LW1", first="USRP1", second="USRP2", time=track.time, score=parted,
    )  # fmt: skip
    audit = AuditResult(
        reference="sionna", links=200, missing_paths=0, extra_paths=2, rss_max_error_db=0.004,
        rank_disagreement={10.0: 0.0, 100.0: 0.0, 1000.0: 0.005}, seconds=0.01, reference_seconds=9.2,
    )  # fmt: skip
    engine = EngineResult(
        engine="image", links=18000, seconds=0.71, paths=38211, settings={"max_depth": 2}, audit=audit,
        left_out=("shed (0.002 dB at most)",),
    )  # fmt: skip
    torn = (
        RejectedLine(17, "11 fields instead of 10", "1,2,3,4,5,6,7,8,9,10,11"),
        RejectedLine(9500, "torn line", '1,"(35.7'),
    )
    inputs = (
        InputFile(path="logs/vehicleOut.txt", sha256="ab" * 32, reader="vehicle_out", lines=9500, accepted=9490,
                  rejected=3, blank=7, role="telemetry", rejected_lines=torn),
        InputFile(path="logs/power_log.txt", sha256="cd" * 32, reader="sounder", lines=6000, accepted=6000, rejected=0,
                  blank=0, role="LW1 USRP1", warnings=("57 repeated lines were re-expanded from '*'.",)),
    )  # fmt: skip
    return ReportData(
        title="Sample flight around LW1, 2024-07-15", flight="sample", site=site, generated="2026-11-21T00:00:00Z",
        versions={"aerpaw-cmp": "0.1.0", "numpy": np.__version__}, inputs=inputs, track=track, waypoints=waypoints,
        rss=rss, verdict=flight_verdict(rss), rank=(make_rank(site, track),), pairs=(pair,), engine=engine, synthetic=True,
        settings={"flight": "sample", "rt": {"max_depth": 2}}, stages_s={"ingest": 0.2, "replay": 0.71, "report": 6.0},
    )  # fmt: skip


@pytest.fixture(scope="session")
def report_data() -> ReportData:
    return make_report()


@pytest.fixture(scope="session")
def small_report(report_data: ReportData) -> ReportData:
    """One RSS panel and the rank, for tests that draw."""
    return dataclasses.replace(report_data, rss=report_data.rss[2:])


def make_maps() -> MapsData:
    """Free space over the paper's grid, with a made-up wood that blocks low positions, and ranks by distance."""
    site = make_site()
    east, north = np.arange(-525.0, 526, 30), np.arange(-1050.0, 1051, 30)
    at = np.stack(np.meshgrid(east, north), axis=-1)
    towers = list(site.towers.values())
    reach = np.array([np.hypot(at[..., 0] - t.east_m, at[..., 1] - t.north_m) for t in towers])
    nearest = reach.argmin(axis=0)
    wood = (at[..., 0] > 150) & (at[..., 0] < 420) & (at[..., 1] > 150) & (at[..., 1] < 420)
    rss, rank, errors = [], [], []
    for antennas, height in itertools.product(("SISO", "MIMO"), (30.0, 70.0, 110.0)):
        levels = {}
        for t, d in zip(towers, reach, strict=True):
            angle = np.arctan2(at[..., 1] - t.north_m, at[..., 0] - t.east_m)
            beam = 0.0 if antennas == "SISO" else 6 * np.cos(4 * angle)
            value = 40 + beam + 20 * np.log10(WAVELENGTH / (4 * np.pi * np.hypot(d, height - 10)))
            levels[t.name] = np.where((wood | (d > 1200)) & (height < 40), np.nan, value)
        levels["joint"] = np.take_along_axis(np.array(list(levels.values())), nearest[None], axis=0)[0]
        rss += [
            RssMap(tower=name, antennas=antennas, height_m=height, values=level, foliage="opaque",
                   coverage=float(np.isfinite(level).mean()))
            for name, level in levels.items()
        ]  # fmt: skip
    d = reach.min(axis=0)
    for (k, radius), height in itertools.product(
        ((10.0, 60.0), (100.0, 160.0), (1000.0, 320.0)), (3.0, *range(30, 111, 10))
    ):
        value = np.where(d < radius / 3, 3, np.where(d < radius * (1 + height / 300), 2, 1))
        value = np.where(wood & (height < 40) | ((d > 250) & (height < 10)), 0, value)
        share = np.array([(value == r).mean() for r in range(5)])
        rank.append(RankMap(k=k, height_m=float(height), values=np.where(value > 0, value, np.nan), share=share))
        errors += [
            MapError(evaluation="leave one out", method=method, k=k, altitude_m=float(height), n=2556,
                     mae=factor * (0.03 + radius / 4000 + 1 / height))
            for method, factor in (("Kriging", 1.0), ("makima", 1.6), ("spline", 1.9)) if height > 10
        ]  # fmt: skip
    distance = np.arange(15.0, 500, 30)
    model = BiExponential(0.2932, -0.0508, 0.7057, -0.001, rmse=0.007)
    lines = tuple(np.array([[-540.0, y], [540.0, y + 150]]) for y in (-350.0, 200.0))
    return MapsData(
        title="Coverage and rank of Lake Wheeler", name="lw", site=site, generated="2026-11-21T00:00:00Z", east_m=east, north_m=north,
        borders_m=lines, rss=tuple(rss), rank=tuple(rank),
        layers=(*(Layer(quantity="Singular value spread", unit="dB", height_m=h, values=20 + d / 30 + h / 10) for h in (30.0, 70.0)), Layer(quantity="Foliage loss", unit="dB", height_m=30.0, values=np.where(wood, -12.0, 0.0)),),
        correlation={"Rank, horizontal": (BinnedCorrelation(distance, distance, model(distance) + 0.01 * np.cos(distance), np.ones(len(distance), int), 2556, 7), model)},
        errors=tuple(errors),
        paper=(PaperRow(where="Fig. 12", what="c1", paper="0.2932", ours="0.2931", figure="correlation"), PaperRow(where="Fig. 13", what="lowest MAE", paper="K = 10", ours="K = 10", figure="mae_leave_one_out")),
        warnings=("Towers of another source differ by up to 9 m.",), versions={"numpy": np.__version__}, settings={"rt": {"max_depth": 2}}, stages_s={"replay": 3.0}, metrics={"fit": {"rmse": 0.0153}},
    )  # fmt: skip


@pytest.fixture(scope="session")
def maps_data() -> MapsData:
    return make_maps()
