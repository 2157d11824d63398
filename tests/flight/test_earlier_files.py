"""A flight.yaml of an earlier release is read as it stands: its sample flight, and the page that lists every key."""

from __future__ import annotations

from pathlib import Path

import pytest

from aerpaw_cmp.flight.settings import load_flight

FILES = sorted((Path(__file__).parent / "earlier").glob("*.yaml"))


def test_there_is_a_file_of_each_release() -> None:
    assert {path.stem.rpartition("_")[2] for path in FILES} == {"0.1", "0.2", "0.3"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_it_is_read(path: Path) -> None:
    settings = load_flight(path)
    assert settings.logs
    assert settings.rt.engine in ("image", "sionna")
