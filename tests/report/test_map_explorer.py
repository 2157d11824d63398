"""The data of the map page's script: the values of the maps in stated steps, and a limited size."""

import base64
import dataclasses
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp import report
from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.report import maps as map_explorer
from aerpaw_cmp.report import maps as maps_html
from aerpaw_cmp.report.maps import JOINT, Layer
from aerpaw_cmp.report.packed import NONE
from aerpaw_cmp.report.page import as_json


def arrays_of(packed):
    block = zlib.decompress(base64.b64decode(packed["data"]))
    return [np.frombuffer(block, f"<{kind}", count=length, offset=offset) for kind, offset, length in packed["arrays"]]


def values_of(content, quantity, **axes):
    """A layer of the page's data as (rows, columns), and its quantity."""
    arrays = arrays_of(content["packed"])
    entry = next(q for q in content["quantities"] if q["name"] == quantity)
    key = ",".join(str(axis["values"].index(axes[axis["name"]])) for axis in entry["axes"])
    stored = arrays[entry["layers"][key]]
    missing = NONE[{np.dtype("<i2"): "i2", np.dtype("u1"): "u1"}[stored.dtype]]
    values = np.where(stored == missing, np.nan, stored * entry["step"])
    return values.reshape(len(arrays[content["north"]]), len(arrays[content["east"]])), entry


def test_every_layer_comes_back_within_half_a_step(maps_data):
    content = json.loads(as_json(map_explorer.payload(maps_data)))
    assert content["left_out"] == ""
    seen = 0
    for layer in map_explorer.page_layers(maps_data):
        values, quantity = values_of(content, layer.quantity, **layer.axes)
        assert np.array_equal(np.isnan(values), np.isnan(layer.values))
        assert np.nanmax(np.abs(values - layer.values)) <= quantity["step"] / 2 + 1e-9
        seen += 1
    assert seen == len(maps_data.rss) + len(maps_data.rank) + len(maps_data.layers)


def test_numbers_of_a_layer_are_those_of_the_tables(maps_data):
    metrics = maps_html.maps_metrics(maps_data)
    numbers = [n for n in metrics["layers"] if n["quantity"] == "RSS"]
    for layer, entry, table in zip(maps_data.rss, numbers, metrics["coverage"], strict=True):
        assert (entry["tower"], entry["antennas"], entry["height"]) == (
            layer.tower,
            layer.antennas,
            f"{layer.height_m:g} m",
        )
        assert entry["covered"] == table["coverage"]
        assert entry["median"] == np.nanmedian(layer.values)
    ranks = [n for n in metrics["layers"] if n["quantity"] == "Rank"]
    assert min(len(numbers), len(ranks)) > 1
    for entry, table in zip(ranks, metrics["rank"], strict=True):
        assert entry["share"] == pytest.approx(table["share"])


def test_a_layer_without_any_value_has_no_numbers():
    layer = Layer(quantity="RSS", unit="dBm", values=np.full((2, 3), np.nan))
    numbers = map_explorer.layer_numbers(layer)
    assert numbers["covered"] == 0.0
    assert np.isnan([numbers[name] for name in ("mean", "median", "min", "max")]).all()


def test_towers_together_come_first_and_heights_rise(maps_data):
    content = map_explorer.payload(dataclasses.replace(maps_data, rss=maps_data.rss[::-1]))
    axes = {axis["name"]: axis["values"] for axis in content["quantities"][0]["axes"]}
    assert axes["Tower"][0] == JOINT
    assert axes["Height"] == ["30 m", "70 m", "110 m"]


def test_a_page_keeps_its_size_whatever_the_grid(maps_data):
    """Use a grid of nine times the cells with a small limit.

    First layers of single towers are omitted, then cells, and the page states it.
    """
    fine = dataclasses.replace(
        maps_data,
        rss=tuple(dataclasses.replace(m, values=np.kron(m.values, np.ones((3, 3)))) for m in maps_data.rss),
        rank=tuple(dataclasses.replace(m, values=np.kron(m.values, np.ones((3, 3)))) for m in maps_data.rank),
        layers=(), east_m=np.linspace(-535, 535, 108), north_m=np.linspace(-1060, 1060, 213),
    )  # fmt: skip
    complete = map_explorer.payload(fine, most_bytes=10**9)
    size = len(complete["packed"]["data"])
    without = map_explorer.payload(fine, most_bytes=size - 1)
    assert without["left_out"] == "layers of single towers"
    assert without["stride"] == 1
    small = map_explorer.payload(fine, most_bytes=size // 40)
    assert len(small["packed"]["data"]) <= size // 40
    assert small["stride"] > 1
    assert f"all but one in {small['stride']} cells" in small["left_out"]
    values, _ = values_of(small, "Rank", **map_explorer.page_layers(fine)[len(fine.rss)].axes)
    assert values.shape == (-(-213 // small["stride"]), -(-108 // small["stride"]))


@pytest.mark.parametrize(("latitude", "reach_m"), [(35.7, 1100.0), (-62.0, 5000.0), (0.0, 200.0)])
def test_positions_in_degrees(latitude, reach_m):
    frame = SiteFrame(latitude, -78.7)
    fit = map_explorer.geographic(frame, np.linspace(-reach_m, reach_m, 5), np.linspace(0, 2 * reach_m, 9))
    assert fit["worst_m"] < 0.001
    e, n = 0.37 * reach_m, 1.234 * reach_m
    u, v = (np.array([e, n]) - fit["middle"]) / fit["reach"]
    lat = sum(c * u**p * v**q for c, (p, q) in zip(fit["lat"], fit["powers"], strict=True))
    lon = sum(c * u**p * v**q for c, (p, q) in zip(fit["lon"], fit["powers"], strict=True))
    assert [lat, lon] == pytest.approx(np.array(frame.to_geographic(e, n)), abs=2e-8)


def test_one_cell_and_absurd_values(maps_data):
    odd = dataclasses.replace(
        maps_data, rss=(), rank=(), east_m=np.array([3.0]), north_m=np.array([7.0]),
        layers=(
            Layer(quantity="huge", unit="1", values=np.array([[1e30]])),
            Layer(quantity="none", unit="", values=np.array([[np.nan]])),
            Layer(quantity="endless", unit="dB", values=np.array([[np.inf]])),
        ),
    )  # fmt: skip
    content = json.loads(as_json(map_explorer.payload(odd)))
    values, quantity = values_of(content, "huge")
    assert values[0, 0] == pytest.approx(1e30, rel=1e-3)
    assert quantity["step"] > 1e24
    assert np.isnan(values_of(content, "endless")[0]).all()
    json.dumps(maps_html.maps_metrics(odd), allow_nan=False)


def test_level_colours_rise_evenly_in_lightness():
    """The lightness CIE L* of the level scale grows by nearly equal steps. The difference scale is lightest at zero."""
    lightness = {}
    script = (Path(report.__file__).parent / "templates/common.js").read_text(encoding="utf-8")
    for name in ("viridis", "RdBu_r"):
        text = re.search(rf'{name}: "([0-9a-f]+)"', script)[1]
        rgb = np.array([[int(text[i + k : i + k + 2], 16) for k in (0, 2, 4)] for i in range(0, len(text), 6)]) / 255
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        y = linear @ [0.2126, 0.7152, 0.0722]
        lightness[name] = 116 * np.cbrt(y) - 16
    steps = np.diff(lightness["viridis"][::8])
    assert steps.min() > 0.5 * steps.mean()
    assert steps.max() < 1.6 * steps.mean()
    diverging = lightness["RdBu_r"]
    assert diverging.argmax() in (63, 64)
    assert (np.diff(diverging[::8][:8]) > 0).all()
