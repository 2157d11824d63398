"""A short, seeded part of the fuzz driver: every target, in this process."""

import contextlib
import warnings
from collections import Counter

import pytest

from aerpaw_cmp.common.errors import AerpawCmpError
from aerpaw_cmp.logs.readers import catalogue
from tests.long import fuzz_inputs as fuzz


@pytest.fixture(scope="module")
def known() -> dict:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("AERPAW_CMP_FIELD_DATA", raising=False)  # the same inputs everywhere
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # rasterio writes the seed
            return {target.name: target for target in fuzz.targets()}


def test_every_reader_of_the_catalogue_is_a_target_with_seeds(known: dict) -> None:
    lacking = {f"reader:{reader.name}" for reader in catalogue()} - set(known)
    assert not lacking, f"no seed for {lacking}: add a sample to tests/parsers/sample_files"
    assert {"flight.yaml", "site.yaml", "campaign.yaml", "map:kmz", "matfile", "flight_file", "path_cache"} <= set(
        known
    )
    assert {"map:geojson", "map:osm", "map:kml", "dem:asc", "antenna:text"} <= set(known)


@pytest.mark.filterwarnings("ignore")
def test_every_seed_is_a_valid_file(known: dict) -> None:
    """Damage to a file that is refused as it is tests the first check alone."""
    refused = []
    for name, target in known.items():
        for number, seed in enumerate(target.seeds[:6]):
            taken = []
            for index in range(len(fuzz.OPTIONS)):
                with contextlib.suppress(AerpawCmpError):
                    taken.append(target.run(seed, index))
            if any(taken) == target.refuses:
                refused.append(f"{name} {number}")
    assert not refused


@pytest.mark.filterwarnings("ignore")
def test_a_short_part_of_the_run_has_no_violation(known: dict) -> None:
    violations, read = [], Counter[str]()
    for name, target in known.items():
        for index in range(10):
            verdict, what, _ = fuzz.one_input(target, 7, index, bounded=False)
            read[name] += verdict == "read"
            if verdict == "violation":
                violations.append(f"{name} {index}: {what}")
    assert not violations
    reading = [name for name, target in known.items() if not target.refuses]
    assert len(reading) > 50
    dead = [name for name in reading if not read[name]]
    # the cache of paths is refused by its seal after any change
    assert "path_cache" in dead
    assert len(dead) <= 4, f"nothing is tested behind the first check of {dead}"
