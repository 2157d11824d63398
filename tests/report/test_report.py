from __future__ import annotations

import json

from aerpaw_cmp.report.export import write_report


def test_whole_report(small_report, tmp_path):
    files = write_report(small_report, tmp_path)
    assert files[0] == tmp_path / "report.html"
    assert all(f.stat().st_size > 0 for f in files)
    assert json.loads((tmp_path / "metrics.json").read_text())["rss"]["LW4"]["USRP1"]["n"] == small_report.rss[0].n
