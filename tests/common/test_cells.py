"""Names from third-party logs are not formulas in the tables of a report."""

import csv
import io

import numpy as np
import pandas as pd
import pytest

from aerpaw_cmp.common.text import guarded, unguarded


@pytest.mark.parametrize("name", ["=cmd|' /C calc'!A0", "+1", "-2+3", "@SUM(A1)", "\tx", "'mine"])
def test_a_text_that_a_spreadsheet_would_run_gets_an_apostrophe_and_comes_back(name: str) -> None:
    table = pd.DataFrame({"channel": ["USRP1", name, name], "rss_db": [-1.5, np.nan, 3.0]})
    rows = list(csv.reader(io.StringIO(guarded(table).to_csv(index=False), newline="")))
    assert [row[0] for row in rows[1:]] == ["USRP1", f"'{name}", f"'{name}"]
    assert [row[1] for row in rows[1:]] == ["-1.5", "", "3.0"], "numbers stay numbers"
    assert [unguarded(row[0]) for row in rows[1:]] == ["USRP1", name, name]


@pytest.mark.parametrize("name", ["LW1;=1+1", "a;b;@SUM(A1);-1", "a;'b", ";=;'=", "'';'"])
def test_no_cell_that_a_semicolon_begins_is_a_formula(name: str) -> None:
    text = guarded(pd.DataFrame({"channel": [name]})).channel[0]
    assert not [cell for cell in text.split(";") if cell.startswith(("=", "+", "-", "@"))]
    assert unguarded(text) == name


def test_a_table_without_such_names_is_the_same_object() -> None:
    table = pd.DataFrame({"channel": ["USRP1"], "rss_db": [-1.5]})
    assert guarded(table) is table
