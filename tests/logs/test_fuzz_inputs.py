"""A short, seeded part of the fuzz driver: every target, in this process; and the driver sees planted faults."""

import warnings

import pytest

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs.readers import catalogue
from benchmarks import fuzz_inputs as fuzz


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
def test_a_short_part_of_the_run_has_no_violation(known: dict) -> None:
    violations, read = [], 0
    for name, target in known.items():
        for index in range(20):
            verdict, what, _ = fuzz.one_input(target, 7, index, bounded=False)
            read += verdict == "read"
            if verdict == "violation":
                violations.append(f"{name} {index}: {what}")
    assert not violations
    assert read > 50, "most mutations must leave something to read, or nothing is tested behind the first check"


def test_an_input_depends_on_seed_target_and_number_alone(known: dict) -> None:
    target = known["flight.yaml"]
    some = [fuzz.mutated(target, 3, i) for i in range(40)]
    assert some == [fuzz.mutated(target, 3, i) for i in range(40)]
    assert len(set(some)) > 35
    assert some != [fuzz.mutated(target, 4, i) for i in range(40)]


def eat(_data: bytes, index: int) -> bool:
    """Faults by the number of the input."""
    if index == 1:
        raise KeyError("a bug")
    if index == 2:
        while True:
            pass
    if index == 3:
        return bool(len(bytearray(600 * 2**20)))
    if index == 4:
        import os

        os._exit(9)
    if index == 5:
        raise InputError(" ")
    if index == 6:
        raise InputError("refused")
    return True


@pytest.mark.filterwarnings("ignore")
def test_planted_faults_are_seen_and_resumed_after(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "LIMIT_S", 0.2)
    target = fuzz.Target("planted", (b"x",), eat)
    messages: list[str] = []
    (row,) = fuzz.run([target], 8, 1, messages.append)
    assert (row["inputs"], row["read"], row["refused"], row["violation"]) == (8, 2, 1, 5)
    for index, words in {
        1: "KeyError",
        2: "more than 0.2 s",
        3: "300 MiB",
        4: "process ended with 9",
        5: "no message",
    }.items():
        assert any(text.startswith(f"planted {index}:") and words in text for text in messages), (index, messages)
