"""Values under NumPy's mask are missing like NaN: gaps of NetCDF and GeoTIFF files have this form."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import aerpaw_cmp as ac
from aerpaw_cmp.common.units import finite_mean, unmasked
from aerpaw_cmp.compare import level, rank, statistics, verdict
from aerpaw_cmp.maps import variogram
from aerpaw_cmp.maps.variogram import fit_biexponential
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element

ROOM = Path(ac.__file__).parent
CHANCE = np.random.default_rng(5)
PLACES = CHANCE.uniform(0.0, 100.0, (40, 2))
LEVELS = CHANCE.normal(-70.0, 3.0, 40)
RANKS = CHANCE.integers(1, 5, 40).astype(float)
TIMES = np.arange(40.0)
H = CHANCE.normal(size=(40, 4, 2)) + 1j * CHANCE.normal(size=(40, 4, 2))
GAPS = np.isin(np.arange(40), [3, 4, 21])


def fall_off(distance_m: Any) -> Any:
    return np.exp(-distance_m / 50.0)


def traced(position_m: Any) -> Any:
    link = Link(3.4e9, {"LW1": single_element()}, single_element())
    poses = Poses(position_m, np.broadcast_to(np.eye(3), (len(position_m), 3, 3)))
    return [ac.trace("lake_wheeler", link, item, max_depth=0).rss_dbm for item in (position_m, poses)]


# A function of the array with gaps, and that array.
CASES: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "Kriging": (lambda z: ac.OrdinaryKriging(fall_off).fit(PLACES, z).predict(PLACES[:9] + 1.0), LEVELS),
    "Kriging of fields": (
        lambda z: ac.OrdinaryKriging(fall_off).fit(PLACES, [[a, b] for a, b in zip(z, z, strict=True)]).predict(PLACES)
        if not np.ma.isMaskedArray(z)
        else ac.OrdinaryKriging(fall_off).fit(PLACES, np.ma.stack([z, z], axis=1)).predict(PLACES),
        LEVELS,
    ),
    "offset": (lambda z: ac.grid_offset(z, LEVELS + 2.0), LEVELS),
    "offset of a list": (lambda z: ac.grid_offset([z, z], [LEVELS, LEVELS]), LEVELS),
    "rank": (lambda h: ac.channel_rank(h, 10.0), H),
    "histogram": (rank.histogram, RANKS),
    "agreement": (lambda r: (rank.agreement(r, RANKS), rank.cohen_kappa(RANKS, r)), np.roll(RANKS, 1)),
    "comparison": (lambda z: level.compare_rss(TIMES, z, LEVELS), LEVELS + CHANCE.normal(size=40)),
    "curve": (lambda y: fit_biexponential(1.0 + TIMES, y), fall_off(1.0 + TIMES)),
    "variogram": (lambda z: variogram.Variogram().fit(PLACES, z)(TIMES), LEVELS),
    "correlation": (lambda z: statistics.correlation(z, TIMES), LEVELS),
    "mean of flights": (verdict.mean_of_flights, LEVELS),
    "mean": (finite_mean, LEVELS),
    "places": (traced, np.column_stack([PLACES, np.full(40, 30.0)])),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_what_a_mask_hides_takes_no_part(name: str) -> None:
    function, values = CASES[name]
    gaps = np.broadcast_to(GAPS.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    beneath = np.where(gaps, 3.0, values)
    expected, given = function(np.where(gaps, np.nan, values)), function(np.ma.array(beneath, mask=gaps))
    as_is = function(beneath)
    np.testing.assert_equal(repr(given), repr(expected))
    assert repr(as_is) != repr(expected), "the gaps matter to this case"


def test_masks_come_in_many_shapes() -> None:
    hidden = np.ma.masked_values([1.0, -9999.0], -9999.0)
    for values in (hidden, [hidden, hidden], (hidden,), np.ma.masked, hidden.astype(int), hidden.astype(complex)):
        assert np.isnan(unmasked(values, complex if np.iscomplexobj(values) else float)).any()
    plain = np.arange(3.0)
    assert unmasked(plain) is plain


def test_no_function_of_arrays_looks_under_a_mask() -> None:
    """``np.asarray`` would drop the mask of an argument. Times may be converted with it, because their gaps are NaT."""
    seen, wrong = 0, []
    for path in ROOM.rglob("*.py"):
        content = path.read_text(encoding="utf-8")
        for function in ast.walk(ast.parse(content if "ArrayLike" in content else "")):
            if isinstance(function, ast.FunctionDef):
                arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
                arrays = {a.arg for a in arguments if a.annotation and "ArrayLike" in ast.unparse(a.annotation)}
                calls = [c for c in ast.walk(function) if isinstance(c, ast.Call) and c.args]
                of_arrays = [c for c in calls if isinstance(c.args[0], ast.Name) and c.args[0].id in arrays]
                texts = {ast.unparse(c.func): ast.unparse(c) for c in of_arrays}
                seen += "unmasked" in texts
                if (text := texts.get("np.asarray") or texts.get("np.array")) and function.name not in ALLOWED:
                    wrong.append(f"{path.relative_to(ROOM)}: {function.name}: {text}")
    assert seen > 50
    assert not wrong


ALLOWED = {"seconds", "nanoseconds", "local_text", "compare_rss", "raster", "unmasked"}
