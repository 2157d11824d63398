"""Columns of line formats: numbers with SI suffix, ranks as written, times up to the range of datetime64, line numbers."""

import re

import numpy as np
import pytest

from aerpaw_cmp.logs import rows as _rows
from aerpaw_cmp.logs.readers import ReadOptions, by_name

OPTIONS = ReadOptions(timezone="America/New_York")
PATTERN = re.compile(rb"^(?P<time>[\d.]+) (?P<value>\S+)$", re.MULTILINE)


def read(data: bytes, clock: str = "epoch_s") -> _rows.Rows:
    return _rows.matched(data, PATTERN, OPTIONS, reader="made", reason=lambda _: "no row", clock=clock)


def test_si_suffixes_scale_by_powers_of_a_thousand() -> None:
    cells = {b"5k": 5e3, b"5M": 5e6, b"5G": 5e9, b"5m": 5e-3, b"5u": 5e-6, b"5n": 5e-9, b"-4.5k": -4.5e3, b"7": 7.0}
    data = b"".join(b"1740927600.5 %s\n" % cell for cell in (*cells, b"nan", b"-"))
    scaled = read(data).si("value")
    np.testing.assert_allclose(scaled[:-2], list(cells.values()), rtol=1e-15)
    assert np.isnan(scaled[-2:]).all()


def test_ranks_1_to_8_are_ranks() -> None:
    written = np.array([0.0, *np.arange(1.0, 9.0), 9.0, 1.5, np.nan])
    rows = read(b"".join(b"1740927600.5 x\n" for _ in written))
    columns = rows.rank(written)
    np.testing.assert_array_equal(columns["rank"], [np.nan, *range(1, 9), np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(columns["ri_raw"], written)
    assert [flag for flag in rows.flag.tolist() if flag] == ["ri_out_of_range"] * 3 + ["no_csi"]


@pytest.mark.parametrize(
    ("reader", "line"),
    [
        ("nemo_csv", b"1,-1500.0,35.72,-78.69,30.5,%s,,,\n"),
        ("quectel_console", b'2025-03-02 10:00:00\n|----+\n| 0 | +QNWCFG: "nr5g_csi" | 24 | %s | 12 | 5 |\n'),
    ],
)
def test_a_fraction_is_no_rank_in_any_format(reader: str, line: bytes) -> None:
    """A mean, or a damaged digit: rank 1.5 would count as a rank of its own."""
    rank = [
        next(s for s in by_name(reader).read(line % cell, OPTIONS).streams if s.kind == "rank").frame["rank"]
        for cell in (b"1.5", b"2.0")
    ]
    assert np.isnan(rank[0]).all()
    assert rank[1].tolist() == [2.0]


@pytest.mark.parametrize(("unit", "per_s"), [("s", 1), ("ms", 10**3), ("us", 10**6)])
def test_times_beyond_the_range_of_datetime64_are_rejected_and_the_others_keep_their_rows(
    unit: str, per_s: int
) -> None:
    seconds = [1_740_927_600, 10_000_000_000, 1_740_927_602, 9_100_000_000]
    data = b"head\n" + b"".join(b"%d v%d\n" % (s * per_s, k) for k, s in enumerate(seconds))
    rows = read(data, f"epoch_{unit}")
    assert [(line.number, line.reason) for line in rows.rejected] == [(1, "no row"), (3, _rows.NO_TIME)]
    assert rows.text("value") == ["v0", "v2", "v3"]
    assert rows.time.tolist() == [s * 10**9 for s in (seconds[0], seconds[2], seconds[3])]
    frame = rows.stream("rank", "c", {"rank": np.ones(3)}).frame
    assert frame["line"].tolist() == [2, 4, 5], "as an editor counts them"
