"""The benchmark script runs, and its two sides agree; its times are not tested."""

import json

import pytest

from benchmarks import kriging


def test_kriging_benchmark_quick(capsys):
    pytest.importorskip("pykrige")
    report = kriging.main(["--quick", "--json"])
    assert json.loads(capsys.readouterr().out) == report
    assert report["leave_one_out"]["largest_difference"] < 1e-9
    assert report["leave_one_out"]["systems"] == 100 * 27
    assert report["moving_window"]["largest_difference_C"] < 1e-9
