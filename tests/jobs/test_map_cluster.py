"""A map in tiles on a real Dask cluster that vanishes half-way."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

distributed = pytest.importorskip("distributed", reason="distributed is not installed (extra 'dev')")
zarr = pytest.importorskip("zarr", reason="zarr is not installed (extra 'geo', Python 3.11)")

from aerpaw_cmp.maps.store import LEDGER  # noqa: E402

TILES = 28  # 10 x 21 positions in tiles of 3


@pytest.fixture
def environ() -> dict[str, str]:
    """TLS for scheduler, worker and client, as a user's configuration names it."""
    security = distributed.security.Security.temporary()
    variables = {"DASK_DISTRIBUTED__COMM__TLS__CA_FILE": security.tls_ca_file}
    for role in ("client", "scheduler", "worker"):
        for kind in ("cert", "key"):
            variables[f"DASK_DISTRIBUTED__COMM__TLS__{role}__{kind}".upper()] = getattr(security, f"tls_{role}_{kind}")
    return {**os.environ, **variables}


def computed(store: Path) -> int:
    """Tiles whose digest the ledger of a store holds."""
    try:
        return int(np.asarray(zarr.open_group(str(store), mode="r")[LEDGER][:]).any(axis=-1).sum())
    except (OSError, KeyError, ValueError):
        return 0


def test_a_cluster_that_vanishes_costs_the_tiles_in_work(environ: dict[str, str], tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "aerpaw_cmp", "map", "lake_wheeler", "-o", "out", "--spacing", "100", "--tile-m", "300",
        "--rss-altitude", "30", "--rank-altitude", "30", "--foliage", "none",
    ]  # fmt: skip
    script = str(Path(__file__).with_name("cluster_process.py"))
    scheduler = subprocess.Popen([sys.executable, script], env=environ, stdout=subprocess.PIPE, text=True)
    assert scheduler.stdout is not None
    try:
        address = scheduler.stdout.readline().strip()
        assert address.startswith("tls://")
        run = subprocess.Popen(
            [*command, "--scheduler", address], cwd=tmp_path, env=environ, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        while computed(tmp_path / "out.zarr") < 2 and run.poll() is None:
            time.sleep(0.05)
    finally:
        scheduler.kill()
        scheduler.communicate()
    _, messages = run.communicate(timeout=120)
    assert run.returncode == 3, messages
    assert "Traceback" not in messages
    assert messages.count("the scheduler of the workers went away") == 1
    count = computed(tmp_path / "out.zarr")
    assert 2 <= count < TILES
    again = subprocess.run(
        [*command, "--json"], cwd=tmp_path, env=environ, capture_output=True, text=True, check=False, timeout=300
    )
    assert again.returncode == 0, again.stderr
    assert f"{count} of {TILES} tiles computed before" in again.stderr
    assert json.loads(again.stdout)["tiles"]["tiles"] == TILES
    assert computed(tmp_path / "out.zarr") == TILES
