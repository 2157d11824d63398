"""Values that JSON does not support become null, text or a mapping. All others are unchanged."""

import json
from dataclasses import dataclass

import numpy as np

from aerpaw_cmp.common.jsonable import fields_of, json_safe


@dataclass(frozen=True)
class Record:
    rmse_db: float
    clock: float | None
    n: int | None = None


def test_numbers_that_are_none_become_null_in_every_container() -> None:
    safe = json_safe(
        {
            "list": [1.0, float("nan"), np.float64("inf")],
            "array": np.array([[1.5, np.nan], [-np.inf, 2.0]]),
            "whole": np.arange(3),
            "truth": np.array([True, False]),
            "time": np.array(["2024-01-01", "NaT"], "datetime64[ns]"),
            "instant": np.datetime64("NaT"),
            10.0: np.float32(0.5),
            2: {"b", "a"},
        }
    )
    assert safe == {
        "list": [1.0, None, None],
        "array": [[1.5, None], [None, 2.0]],
        "whole": [0, 1, 2],
        "truth": [True, False],
        "time": ["2024-01-01T00:00:00.000000000", "NaT"],
        "instant": None,
        "10": 0.5,
        "2": ["a", "b"],
    }
    assert json.loads(json.dumps(safe, allow_nan=False)) == safe


def test_a_record_gives_its_fields_and_leaves_out_what_it_has_not() -> None:
    assert json_safe([Record(rmse_db=float("nan"), clock=None)]) == [{"rmse_db": None, "clock": None}]
    assert fields_of(Record(rmse_db=1.0, clock=2.0, n=0)) == {"rmse_db": 1.0, "clock": 2.0, "n": 0}
