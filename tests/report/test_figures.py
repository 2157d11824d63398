import dataclasses
import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from matplotlib.colors import to_rgb

from aerpaw_cmp.common.kml import CLASS_COLOURS
from aerpaw_cmp.compare.result import RankResult, RssResult
from aerpaw_cmp.report import canvas
from aerpaw_cmp.report import flight as html
from aerpaw_cmp.report import flight_figures as figures
from aerpaw_cmp.report.flight_data import DrawnTrack, ReportData, start_of, used_towers
from aerpaw_cmp.site.siteyaml import load_site
from benchmarks.fabricated import rank_result, rss_result, with_numbers


def drawn(data: ReportData):
    for spec in figures.figure_specs(data):
        with canvas.style():
            fig = spec.draw()
        yield spec, fig


def data_axes(fig):
    return [ax for ax in fig.axes if ax.get_visible() and ax.get_label() != "<colorbar>"]


def test_every_figure_has_labels_with_units_and_a_legend(small_report):
    seen = []
    for spec, fig in drawn(small_report):
        seen.append(spec.name)
        axes = data_axes(fig)
        assert axes, spec.name
        assert any(ax.get_xlabel() for ax in axes), spec.name
        assert any(ax.get_ylabel() for ax in axes), spec.name
        labels = [ax.get_xlabel() for ax in fig.axes] + [ax.get_ylabel() for ax in fig.axes]
        assert any("[" in label or "rank" in label.lower() or "K (" in label for label in labels), (spec.name, labels)
        has_legend = (
            fig.legends or any(ax.get_legend() for ax in axes) or any(ax.get_label() == "<colorbar>" for ax in fig.axes)
        )
        assert has_legend, spec.name
    assert {"trajectory", "altitude", "rss_LW4_USRP1", "rank_map_LW1", "rank_histogram_LW1"} <= set(seen)
    assert len(seen) == len(set(seen))


def test_file_names_are_safe_and_unique(report_data):
    panels = tuple(dataclasses.replace(report_data.rss[0], tower="../LW 1", channel=c) for c in ("a/b", "a b"))
    names = [p.name for p in figures.figure_specs(dataclasses.replace(report_data, rss=panels))]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+", name) for name in names)
    assert len(names) == len(set(names))


def compared_again(panel: RssResult, rows: object, **change: object) -> RssResult:
    """The comparison of some of its samples."""
    levels = {"measured": panel.measured_db, "simulated": panel.simulated_dbm}
    levels |= {name: model.level_dbm for name, model in panel.baselines.items()}
    return rss_result(
        panel.tower, panel.channel, panel.time[rows], panel.position_m[rows],
        {name: level[rows] for name, level in levels.items()} | change,
        geometry={name: values[rows] for name, values in panel.geometry.items()},
        line_of_sight=panel.line_of_sight[rows],
    )  # fmt: skip


def long_panel(panel: RssResult, times: int) -> RssResult:
    long = compared_again(panel, np.tile(np.arange(len(panel.time)), times))
    time = panel.time[0] + (np.arange(len(long.time)) * 1e8).astype("timedelta64[ns]")
    return dataclasses.replace(long, time=time, geometry={})


def test_svg_stays_small_however_long_the_flight(report_data):
    panel = long_panel(report_data.rss[2], 8)
    data = dataclasses.replace(report_data, rss=(panel,))
    with canvas.style():
        svg = canvas.save_as(figures.rss_over_time(data, panel), ("svg",))["svg"]
    assert len(panel.time) == 48_000
    assert len(svg) < 500_000


def test_svg_has_no_reference_to_elsewhere_and_is_the_same_twice(small_report):
    spec = next(p for p in figures.figure_specs(small_report) if p.name == "altitude")
    first, redrawn = canvas.render(spec, ("svg",)), canvas.render(spec, ("svg",))
    assert first["svg"] == redrawn["svg"]
    fetched = re.findall(rb'(?:href|src)="([^"]*)"', first["svg"])
    assert all(f.startswith((b"#", b"data:")) for f in fetched)


def test_style_leaves_the_users_settings_alone(small_report):
    import matplotlib

    before = dict(matplotlib.rcParams)
    canvas.render(figures.figure_specs(small_report)[1])
    assert dict(matplotlib.rcParams) == before


def one_sample(panel: RssResult) -> RssResult:
    return compared_again(panel, slice(3000, 3001))


def all_out(panel: RssResult) -> RssResult:
    return compared_again(panel, slice(None), simulated=np.full(len(panel.time), np.nan))


def no_csi(panel: RankResult) -> RankResult:
    n = len(panel.time)
    return rank_result("LW1", panel.time, panel.position_m, np.full(n, np.nan), np.zeros((n, 4, 4), dtype=complex))


def few_thresholds(panel: RankResult, most: int) -> RankResult:
    thresholds = list(panel.rank)[:most]
    simulated = {k: panel.score.simulated[k] for k in thresholds}
    return with_numbers(panel, rank={k: panel.rank[k] for k in thresholds}, simulated=simulated)


def still(track: DrawnTrack) -> DrawnTrack:
    return dataclasses.replace(track, position_m=np.tile([5.0, 5.0, 0.5], (len(track.time), 1)))


@pytest.fixture(scope="module")
def drawn_before():
    """Pictures of the flight and of pairs, by all that they are made of: the same one again would show nothing."""
    return set()


@pytest.mark.parametrize(
    "change",
    [
        lambda d: {"rss": (one_sample(d.rss[0]),), "rank": ()},
        lambda d: {"rss": (all_out(d.rss[2]),), "rank": ()},
        lambda d: {"rss": (with_numbers(d.rss[2], offset_db=50.0, at_edge=True),), "rank": ()},
        lambda d: {"rss": (), "rank": (no_csi(d.rank[0]),)},
        lambda d: {"rss": (), "rank": (few_thresholds(d.rank[0], 0),)},
        lambda d: {"rss": (), "rank": (few_thresholds(d.rank[0], 1),)},
        lambda d: {"rss": (), "rank": (), "track": still(d.track)},
        lambda d: {"rss": (), "rank": (), "track": DrawnTrack(time=d.track.time[:1], position_m=d.track.position_m[:1])},
        lambda d: {"rss": (), "rank": (), "track": dataclasses.replace(d.track, position_m=d.track.position_m * [1.0, 1.0, np.nan])},
        lambda d: {"rss": (), "rank": (), "site": dataclasses.replace(d.site, towers={}, buildings=(), forests=(), geofences=(), trees=type(d.site.trees).none())},
    ],
    ids=["one sample", "all out of coverage", "edge", "no CSI at all", "rank without simulation", "one K", "hovering", "one pose", "no height", "bare site"],
)  # fmt: skip
def test_odd_flights_are_drawn_without_a_warning(report_data, drawn_before, change):
    data = dataclasses.replace(report_data, **change(report_data))
    left_alone = data.track is report_data.track and data.site is report_data.site
    for spec in figures.figure_specs(data):
        if left_alone and spec.name in (
            "trajectory",
            "altitude",
            "rss_channels_LW1_USRP1_USRP2",
        ):  # these have of the panels only what is named:
            what = (spec.name, start_of(data), *used_towers(data))
            if what in drawn_before:
                continue
            drawn_before.add(what)
        with canvas.style():
            spec.draw().draw_without_rendering()  # lays out and draws every part; warnings are errors


@given(arrays(bool, st.integers(0, 60)))
def test_runs_cover_exactly_the_true_samples(mask):
    again = np.zeros(len(mask), dtype=bool)
    spans = list(zip(*canvas.runs(mask), strict=True))
    for a, b in spans:
        assert not again[a : b + 1].any()
        again[a : b + 1] = True
    np.testing.assert_array_equal(again, mask)
    assert all(b + 1 < c for (_, b), (c, _) in pairwise(spans)), "neighbouring spans are one"


@given(st.integers(0, 500), st.integers(10, 80), st.randoms())
def test_thinning_keeps_extremes_order_and_size(n, limit, random):
    level = np.array([random.gauss(0, 1) for _ in range(n)])
    at = np.arange(n, dtype=float)
    a, b = canvas.thinned(at, level, limit)
    assert len(a) <= max(limit + 2, n if n <= limit else 0)
    assert (np.diff(a) >= 0).all()
    assert set(zip(a, b, strict=True)) <= set(zip(at, level, strict=True))
    if n:
        assert (b.min(), b.max()) == (level.min(), level.max())


def test_thinning_keeps_a_gap_open():
    level = np.sin(np.arange(10_000.0))
    level[4000:6000] = np.nan
    a, b = canvas.thinned(np.arange(10_000.0), level, 500)
    assert not np.isfinite(b[(a > 4050) & (a < 5950)]).any()
    assert np.isnan(b).any()


def test_residual_sign_is_measured_minus_simulated(report_data):
    panel = report_data.rss[0]
    higher = dataclasses.replace(panel, measured_db=panel.measured_db + 1.0)
    np.testing.assert_allclose(higher.residual_db - panel.residual_db, 1.0)


def test_grey_steps_of_the_ranks_are_apart():
    grey = [np.dot(to_rgb(CLASS_COLOURS[r]), (0.299, 0.587, 0.114)) for r in (1, 2, 3, 4)]
    assert min(np.diff(grey)) > 0.12


def relative(data: ReportData) -> ReportData:
    """The same flight from logs whose times are relative: they count from 1970."""
    back = data.track.time[0] - np.datetime64("1969-12-31T23:57:31", "ns")
    rss = tuple(dataclasses.replace(p, time=p.time - back) for p in data.rss)
    pairs = tuple(dataclasses.replace(p, time=p.time - back) for p in data.pairs)
    return dataclasses.replace(
        data, track=dataclasses.replace(data.track, time=data.track.time - back), waypoints=(), rss=rss, pairs=pairs,
        rank=tuple(dataclasses.replace(p, time=p.time - back) for p in data.rank),
    )  # fmt: skip


def test_relative_times_count_from_the_first_sample(small_report):
    data = relative(small_report)
    labels = [ax.get_xlabel() for _, fig in drawn(data) for ax in data_axes(fig) if "Time after" in ax.get_xlabel()]
    assert labels
    assert set(labels) == {"Time after the first sample [s]"}
    assert any(panel.spans for panel in data.rss)
    page = html.page(data, [])
    assert "From (s)" in page
    assert "23:57" not in page


ODD_NAMES = ("A_$", r"$\frac{", "_hidden", "a$b$c_{", "<b>&amp;", "%s {0} \\")


def test_names_are_drawn_as_they_are(small_report):
    """A waypoint may be called ``A_$``: no name is a formula, and none hides its line of the legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    points = tuple(
        dataclasses.replace(point, label=ODD_NAMES[i % len(ODD_NAMES)])
        for i, point in enumerate(small_report.waypoints)
    )
    towers = {f"{ODD_NAMES[i]} {i}": tower for i, tower in enumerate(list(small_report.site.towers.values())[:3])}
    data = dataclasses.replace(
        small_report,
        waypoints=points,
        site=dataclasses.replace(small_report.site, towers=towers),
        rss=tuple(dataclasses.replace(p, tower="$x_{", channel="_$") for p in small_report.rss[:1]),
        rank=tuple(dataclasses.replace(p, tower=r"$\alpha") for p in small_report.rank[:1]),
    )
    seen = set()
    for spec, fig in drawn(data):
        texts = [text for text in fig.findobj(Text) if text.get_text()]
        assert not any(text.get_parse_math() for text in texts), spec.name
        seen |= {text.get_text() for text in texts}
        if spec.name == "trajectory" or spec.name.startswith("rank_singular"):
            FigureCanvasAgg(fig).draw()
    assert "A_$" in seen
    assert "σ₂/σ₁" in seen


def test_dots_of_a_long_flight_are_a_picture_inside_the_svg(report_data):
    panel = long_panel(report_data.rss[2], 4)
    fig = figures.rss_over_time(dataclasses.replace(report_data, rss=(panel,)), panel)
    (dots,) = [line for line in fig.axes[0].lines if line.get_label().startswith("measured")]
    assert dots.get_rasterized()
    np.testing.assert_array_equal(dots.get_ydata(), panel.measured_db)


def test_very_many_outages_are_joined_where_no_eye_parts_them():
    seconds = np.arange(100_000.0)
    for period, count in ((10, 1), (1000, 100)):
        spans = figures._spans(seconds, seconds % period < period / 2, "out")
        assert len(spans["x"]) == len(spans["ends"]) == count
        assert spans["x"][0] == -0.5
    assert spans["ends"][0] == 499.5
    assert len(figures._spans(seconds, seconds < 0, "out")["x"]) == 0


def test_a_point_between_two_gaps_of_a_line_has_a_dot():
    _, ax = canvas.subplots((4.0, 4.0))
    level = np.array([1.0, 2.0, np.nan, 3.0, np.nan, np.nan, 4.0, 5.0])
    canvas.draw_marks(ax, [canvas.mark("line", "level", np.arange(8.0), level)])
    assert np.flatnonzero(ax.lines[0].get_markevery()).tolist() == [3]


def test_both_channels_of_a_tower_stand_in_one_panel(report_data):
    """The second channel is moved by its offset minus that of the first.

    Spans in which the channels differ are shaded.
    """
    (spec,) = [spec for spec in figures.figure_specs(report_data) if spec.name.startswith("rss_channels")]
    assert spec.name == "rss_channels_LW1_USRP1_USRP2"
    (ax,) = spec.draw().axes
    first, second, _ = report_data.rss
    lines = {line.get_label().split(",")[0]: line.get_ydata() for line in ax.lines}
    moved = second.score.offset_db - first.score.offset_db
    np.testing.assert_allclose(np.sort(lines["USRP1"]), np.sort(first.measured_db))
    np.testing.assert_allclose(np.sort(lines["USRP2"]), np.sort(second.measured_db + moved))
    assert np.nanmax(lines["ray tracing"]) == pytest.approx(np.nanmax(first.simulated_dbm) - first.score.offset_db)
    (shaded,) = [each for each in ax.collections if each.get_label() == "channels differ"]
    assert len(shaded.get_paths()) == len(report_data.pairs[0].score.spans) > 0
    assert ax.get_ylabel() == f"RSS [{first.unit}]"


def test_names_of_towers_stay_inside_the_plan() -> None:
    site = load_site("lake_wheeler")
    fig, ax = canvas.subplots((4.0, 4.0), 1, 1)
    canvas.draw_site(ax, site)
    canvas.frame_around(ax, *np.array([tower.position_m[:2] for tower in site.towers.values()]).T, margin=0.01)
    fig.canvas.draw()
    names = [text.get_window_extent() for text in ax.texts if text.get_text() in site.towers]
    (credit,) = (text.get_window_extent() for text in ax.texts if text.get_gid() == "credit")
    assert len(names) == 5
    assert all(ax.bbox.padded(2).contains(*name.max) and not name.overlaps(credit) for name in names)


def test_a_pose_without_a_position_does_not_change_the_shape_of_a_plan():
    east, north = np.array([0.0, np.nan, 60.0, 30.0]), np.array([0.0, 90.0, 20.0, np.nan])
    assert canvas.plan_shape(east, north) == pytest.approx(120.0 / 80.0)  # 60 m x 20 m, with 30 m around
