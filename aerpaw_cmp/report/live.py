"""The page of ``tap --web``: one file that contains its map and requests data only from the tap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from ..common.units import AnyArray, FloatArray
from ..site.site import Site
from .packed import PackedArrays, plan_of
from .page import as_json, digest, environment, script
from .texts import k_key

_POLICY = (
    "default-src 'none'; script-src {script}; style-src {style}; connect-src 'self'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveMap:
    """The predicted rank and level over the site for one tower, shape (heights, north, east).

    Parameters
    ----------
    title : str
        Title of the flight.
    site : Site
    tower : str
    k : float
        Singular-value ratio of the ranks.
    heights_m, east_m, north_m : sequence of float
        Axes of the grid, evenly spaced east and north [m].
    rank : (heights, north, east) int
        Rank; 0 without a path.
    level_dbm : (heights, north, east) float
        Level [dBm]; NaN without a path.
    """

    title: str
    site: Site
    tower: str
    k: float
    heights_m: Sequence[float]
    east_m: FloatArray
    north_m: FloatArray
    rank: AnyArray
    level_dbm: FloatArray

    def content(self) -> dict[str, Any]:
        """Return plain values for the script."""
        arrays = PackedArrays()
        rank, level = arrays.add(np.clip(self.rank, 0, 4), "u1"), arrays.add_steps(self.level_dbm, 0.1)
        step = float(self.east_m[1] - self.east_m[0]) if len(self.east_m) > 1 else 20.0
        return {
            "site": plan_of(self.site),
            "tower": self.tower,
            "k": k_key(self.k),
            "heights": [float(height) for height in self.heights_m],
            "east": float(self.east_m[0]),
            "north": float(self.north_m[0]),
            "step": step,
            "columns": len(self.east_m),
            "rows": len(self.north_m),
            "rank": rank,
            "level": level,
            **arrays.content(),
        }


def live_page(background: LiveMap | None, title: str) -> tuple[bytes, str]:
    """Return the page and its Content-Security-Policy.

    Parameters
    ----------
    background : LiveMap, optional
        Without a prediction the page shows the measurement alone, without a map.
    title : str
        Text next to the heading.
    """
    style, code = script("live.css"), script("common.js", "live.js")
    text = (
        environment()
        .get_template("live.html.jinja")
        .render(
            title=title,
            mapped=background is not None,
            style=Markup(style),
            script=Markup(code),
            scene=Markup(as_json(background.content() if background else {})),
        )
    )
    return text.encode(), _POLICY.format(script=digest(code), style=digest(style))
