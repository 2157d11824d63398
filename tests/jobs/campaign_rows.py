"""Make rows of a campaign with levels and places. Numbers that the functions under test do not read are NaN."""

from typing import Any

import numpy as np

from aerpaw_cmp.report.campaign import RssRow


def rss_row(flight: str, channel: str, measured: Any, simulated: Any, **keys: Any) -> RssRow:
    """Return an invented row of LW1. ``keys`` replace its values."""
    measured, simulated = np.asarray(measured, float), np.asarray(simulated, float)
    n = len(measured)
    nan = float("nan")
    given: dict[str, Any] = {
        "unit": "dBm", "offset_db": float(np.nanmean(simulated - measured)), "rmse_db": nan, "correlation": nan, "n": n,
        "n_out_of_coverage": 0, "at_search_edge": False, "rmse_ci95_db": None, "offset_ci95_db": None,
        "correlation_ci95": None, "n_effective": nan, "lag_s": nan, "lag_verdict": "", "fitted": (), "baselines": {},
        "span_db": (-50.0, 50.0),
        "position_m": np.stack([np.arange(n) * 3.0, np.zeros(n), np.full(n, 40.0)], axis=-1),
    }  # fmt: skip
    return RssRow(
        flight=flight, setting="s", tower="LW1", channel=channel, measured_db=measured, simulated_dbm=simulated,
        **{**given, **keys},
    )  # fmt: skip
