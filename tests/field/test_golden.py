"""Every file of the field data, with its reader and counts, or with its kind if it is not a log.

``golden.csv`` has one line per file: path, reader, lines, accepted and rejected lines, number of streams and of their
rows. For a file that is not a log, it contains ``no log`` and the kind of the file. The counts of the text logs were also
determined by other means (grep, SciPy).
"""

import csv
import os
from pathlib import Path

import pytest

from aerpaw_cmp.logs.ingest import Ingested
from tests.real_logs import REAL

pytestmark = pytest.mark.field
TABLE = list(csv.reader((Path(__file__).parent / "golden.csv").read_text().splitlines()))[1:]


def rows_of(ingested: Ingested) -> dict[str, list[str]]:
    rows = {}
    for file in ingested:
        result = file.result
        counts = (result.lines, result.accepted, len(result.rejected), len(result.streams))
        total = sum(len(stream.frame) for stream in result.streams)
        rows[os.path.relpath(file.path, REAL)] = [result.reader, *map(str, (*counts, total))]
    for left in ingested.skipped:
        rows[os.path.relpath(left.path, REAL)] = ["no log", left.reason.removeprefix("not a log: ")]
    return rows


@pytest.fixture(scope="module")
def rows(field_logs: Ingested) -> dict[str, list[str]]:
    return rows_of(field_logs)


def test_no_file_is_left_without_a_word(rows: dict[str, list[str]]) -> None:
    assert set(rows) == {row[0] for row in TABLE}
    assert not any("no reader recognises" in row[-1] for row in rows.values())


@pytest.mark.parametrize("row", TABLE, ids=[row[0] for row in TABLE])
def test_golden_counts(rows: dict[str, list[str]], row: list[str]) -> None:
    assert rows[row[0]] == [cell for cell in row[1:] if cell]
