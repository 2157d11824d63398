"""A flight.yaml of an earlier release is read as it stands: its sample flight, and the page that lists every key."""

from pathlib import Path

import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.flight.overrides import overridden
from aerpaw_cmp.flight.settings import FlightFile, load_flight

FILES = sorted((Path(__file__).parent / "earlier").glob("*.yaml"))


def test_there_is_a_file_of_each_release() -> None:
    assert {path.stem.rpartition("_")[2] for path in FILES} == {"0.1", "0.2", "0.3"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_it_is_read(path: Path) -> None:
    settings = load_flight(path)
    assert settings.logs
    assert settings.rt.engine in ("image", "sionna")


def written(folder: Path, text: str) -> FlightFile:
    path = folder / "flight.yaml"
    path.write_text(f"flight: f\nlogs: [{{path: a.txt}}]\n{text}")
    return load_flight(path)


def test_knobs_at_their_old_place_are_read_and_told(tmp_path: Path) -> None:
    settings = written(
        tmp_path,
        "rt: {batch: 7, maximum_gap_s: 9, advanced: {threads: 3}}\nrss: {step_db: 0.5, bootstrap: 10}\n"
        "rank: {bootstrap: 20}\nreport: {speed_table: true}\n",
    )
    assert (settings.rt.advanced.maximum_gap_s, settings.rt.advanced.threads) == (9.0, 3)
    assert (settings.rss.advanced.step_db, settings.rank.advanced.bootstrap) == (0.5, 20)
    (note,) = settings.flight.notes
    for words in (
        "rt.maximum_gap_s (write advanced.maximum_gap_s)",
        "rss.step_db (write advanced.step_db)",
        "rank.bootstrap (write advanced.bootstrap)",
        "rt.batch (has no effect)",
        "rss.bootstrap (has no effect)",
        "report.speed_table (has no effect)",
    ):
        assert words in note


def test_todays_file_has_no_such_note(tmp_path: Path) -> None:
    settings = written(tmp_path, "rt: {advanced: {maximum_gap_s: 9}}\nrss: {advanced: {step_db: 0.5}}\n")
    assert settings.flight.notes == []
    assert settings.rt.advanced.maximum_gap_s == 9.0


def test_a_dotted_key_of_an_earlier_campaign_reaches_the_knob(tmp_path: Path) -> None:
    settings = overridden(written(tmp_path, "rt: {advanced: {maximum_gap_s: 9}}\n"), {"rt.maximum_gap_s": 4.0})
    assert settings.rt.advanced.maximum_gap_s == 4.0


def test_interactions_of_sionna_are_refused_with_what_to_write_instead(tmp_path: Path) -> None:
    assert "rt.interactions" in written(tmp_path, "rt: {interactions: [reflection]}\n").flight.notes[0]
    with pytest.raises(UsageError, match=r"flight\.yaml, line 3: rt: .*use diffraction: edges"):
        written(tmp_path, "rt: {engine: sionna, interactions: [reflection, diffraction]}\n")


def test_a_gain_written_by_hand_is_refused_with_what_to_write_instead(tmp_path: Path) -> None:
    antenna = "link: {rss: {carrier_hz: 3.3e9, uav: {antenna: {model: dipole, installed_db: %s}}}}\n"
    assert written(tmp_path, antenna % "[]").link.rss.uav.antenna.model == "dipole"
    with pytest.raises(UsageError, match=r"flight\.yaml, line 3: .*installed_db is gone.*model: sphere"):
        written(tmp_path, antenna % "[1.0, 2.0]")
