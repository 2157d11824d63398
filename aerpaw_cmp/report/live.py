"""The page of ``tap --web``, one file that contains its map and requests data only from the tap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from ..common.units import AnyArray, FloatArray
from ..maps.grid import Grid
from ..site.site import Site
from .packed import PackedArrays, plan_of
from .page import as_json, digest, environment, script
from .texts import k_key

_POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; connect-src 'self'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)


def live_map(
    site: Site, tower: str, k: float, heights_m: Sequence[float], grid: Grid, values: tuple[AnyArray, FloatArray]
) -> dict[str, Any]:
    """Return the predicted rank and level over a site as plain values for the script of the page.

    Parameters
    ----------
    site : Site
    tower : str
    k : float
        Singular-value ratio of the ranks.
    heights_m : sequence of float
    grid : Grid
    values : (heights, north, east) int, (heights, north, east) float
        Rank (0 without a path), and level [dBm] (NaN without a path).

    Returns
    -------
    dict
    """
    arrays = PackedArrays()
    rank, level = arrays.add(np.clip(values[0], 0, 4), "u1"), arrays.add_steps(values[1], 0.1)
    return {
        "site": plan_of(site),
        "tower": tower,
        "k": k_key(k),
        "heights": [float(height) for height in heights_m],
        "east": float(grid.east_m[0]),
        "north": float(grid.north_m[0]),
        "step": float(grid.east_m[1] - grid.east_m[0]) if len(grid.east_m) > 1 else 20.0,
        "columns": len(grid.east_m),
        "rows": len(grid.north_m),
        "rank": rank,
        "level": level,
        **arrays.content(),
    }


def live_page(background: dict[str, Any] | None, title: str) -> tuple[bytes, str]:
    """Return the page and its Content-Security-Policy.

    Parameters
    ----------
    background : dict, optional
        Result of :func:`live_map`. With None, the page has no map and shows only the measurement.
    title : str
        Text beside the heading.
    """
    style, code = script("live.css"), script("common.js", "live.js")
    shown = {"title": title, "mapped": background is not None, "scene": Markup(as_json(background or {}))}
    page = environment().get_template("live.html.jinja")
    text = page.render(style=Markup(style), script=Markup(code), **shown)
    return text.encode(), _POLICY.format(script=digest(code), style=digest(style))
