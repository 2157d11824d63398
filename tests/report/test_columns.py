"""One table declares the columns of CSV, the page and docs/outputs.md.

python -m tests.report.test_columns        writes the tables of docs/outputs.md
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.report import columns as report_columns
from aerpaw_cmp.report import flight
from aerpaw_cmp.report.columns import RANK, RSS, Column, csv_text, described, header, tables
from aerpaw_cmp.report.flight_data import ReportData

DOCS = Path(__file__).parents[2] / "docs" / "outputs.md"
BEGIN, END = "<!-- columns -->\n", "<!-- end of columns -->"


def written() -> str:
    """The tables as docs/outputs.md has them."""
    lines = []
    for name, columns in (("rss.csv", RSS), ("rank.csv", RANK)):
        always = [described([column])[0] for column in columns if not column.optional]
        some = [described([column])[0] for column in columns if column.optional]
        lines += [f"| {name} | unit | meaning |", "| --- | --- | --- |"]
        lines += [f"| `{column}` | {unit} | {meaning} |" for column, unit, meaning in always]
        lines += [f"| `{column}`, where it exists | {unit} | {meaning} |" for column, unit, meaning in some] + [""]
    return "\n".join(lines)


def test_the_docs_have_the_columns_of_the_code() -> None:
    text = DOCS.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0]
    assert text == written(), "python -m tests.report.test_columns"


def test_a_new_column_is_one_row(report_data: ReportData, monkeypatch: pytest.MonkeyPatch) -> None:
    """File and page have it, with unit and meaning."""
    twice = Column("twice_db", "dB", "twice the residual", lambda p: 2.0 * p.residual_db)
    monkeypatch.setattr(report_columns, "RSS", (*RSS, twice))
    monkeypatch.setattr(flight, "RSS", (*RSS, twice))
    head, first = "".join(csv_text(report_columns.RSS, report_data.rss)).splitlines()[:2]
    assert head.split(",")[-1] == "twice_db"
    residual = float(first.split(",")[head.split(",").index("residual_db")])
    assert float(first.split(",")[-1]) == pytest.approx(2.0 * residual, abs=2e-4)
    assert "twice the residual" in flight.page(report_data, [])


def test_a_column_of_some_series_is_empty_in_the_others(report_data: ReportData) -> None:
    """A family contains the members of all series in one order. Without any series, no header contains its name."""
    first, second = report_data.rss[:2]
    fewer = dataclasses.replace(second, baselines={"two_ray": second.baselines["two_ray"]})
    columns, rows = tables(RSS, [first, fewer])
    assert [column.name for column in columns if column.name.endswith("_dbm")][1:] == ["free_space_dbm", "two_ray_dbm"]
    assert np.isnan(rows[1][1]["free_space_dbm"]).all()
    assert list(rows[0][1]) == list(rows[1][1]) == [column.name for column in columns]
    (text,) = csv_text(RSS, [])
    assert text == ",".join(header(RSS)) + "\n"
    assert not any("{}" in name for name in header(RSS) + header(RANK))
    names = [column.name for column in tables(RANK, report_data.rank)[0]]
    assert [name for name in names if "rank_k" in name] == [f"simulated_rank_k{k}" for k in (10, 100, 1000)]


if __name__ == "__main__":
    before, _, rest = DOCS.read_text(encoding="utf-8").partition(BEGIN)
    DOCS.write_text(before + BEGIN + written() + END + rest.partition(END)[2], encoding="utf-8")
