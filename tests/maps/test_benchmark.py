"""The benchmark script runs, and its two sides agree; its times are not tested."""

import importlib.util
import json
from pathlib import Path

import pytest


def test_kriging_benchmark_quick(capsys):
    pytest.importorskip("pykrige")
    path = Path(__file__).parents[2] / "benchmarks" / "kriging.py"
    spec = importlib.util.spec_from_file_location("benchmark_kriging", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    report = module.main(["--quick", "--json"])
    assert json.loads(capsys.readouterr().out) == report
    assert report["leave_one_out"]["largest_difference"] < 1e-9
    assert report["leave_one_out"]["systems"] == 100 * 27
    assert report["moving_window"]["largest_difference_C"] < 1e-9
