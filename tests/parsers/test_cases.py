"""Logs that were once read wrongly, reduced and invented, with variants in other words and orders.

``cases/`` contains the files. The expected values come from the content of the files, not from the output of a reader.
"""

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from aerpaw_cmp.cli import main
from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs.run import mapping
from aerpaw_cmp.logs import frames
from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.readers import ReadOptions
from aerpaw_cmp.logs.records import ReadResult

CASES = Path(__file__).parent / "cases"
NEW_YORK = {"timezone": "America/New_York"}
START = "2025-06-10T14:00:00"
NAN = float("nan")


@dataclass(frozen=True)
class Right:
    """The content of a log: columns of streams by name, the first time, words of a warning, parts of attributes."""

    streams: dict[str, dict[str, list[float]]]
    start: str = START
    said: str = ""
    about: dict[str, object] = field(default_factory=dict)
    maps: tuple[str, ...] = ()
    options: dict[str, str] = field(default_factory=dict)
    text: str = ""
    encoding: str = "utf-8"


def read(path: Path, maps: tuple[str, ...], options: dict[str, str]) -> ReadResult:
    keys = {**options, **(mapping(list(maps)) if maps else {})}
    (file,) = ingest([path], options=ReadOptions(**keys), reader="generic_csv" if maps else None)
    return file.result


def check(result: ReadResult, right: Right) -> None:
    streams = {stream.name: stream for stream in result.streams}
    assert right.streams.keys() <= streams.keys(), streams.keys()
    for name, columns in right.streams.items():
        frame = streams[name].frame
        for column, values in columns.items():
            shown = frame[column].to_numpy(dtype=np.float64)
            np.testing.assert_allclose(shown, values, rtol=0, atol=1e-5 if "deg" in column else 6e-3)
        assert right.about.items() <= streams[name].attributes.items(), streams[name].attributes
    if right.start:
        first = min(stream.frame["time"].min() for name, stream in streams.items() if name in right.streams)
        assert first == pd.Timestamp(right.start)
    assert any(right.said in text for text in result.warnings) or not right.said, result.warnings


def cases(name: str) -> dict[str, Right]:
    """Read a table next to ``cases/``, whose keys are the fields of :class:`Right`."""
    table = yaml.load((CASES / name).read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {key: Right(**entry) for key, entry in table.items()}


RIGHT, AUTOPILOTS, COUSINS = (cases(f"{name}.yaml") for name in ("logs", "autopilots", "cousins"))
REFUSED = {"35_levels_no_time.kml": "levels and positions without times", "49_wifi_scan.txt": "a Wi-Fi scan"}


def test_every_case_has_its_right_value() -> None:
    files = {path.relative_to(CASES / "logs").as_posix() for path in (CASES / "logs").rglob("*") if path.is_file()}
    assert {name for name in files if not name.endswith("sigmf-data")} == {*RIGHT, *REFUSED}


@pytest.mark.parametrize("name", RIGHT)
def test_a_log_is_read_as_it_says_it(name: str) -> None:
    right = RIGHT[name]
    check(read(CASES / "logs" / name, right.maps, right.options), right)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_log_is_called_what_it_is(name: str) -> None:
    with pytest.raises(InputError, match=REFUSED[name]):
        read(CASES / "logs" / name, (), NEW_YORK)


@pytest.mark.parametrize("name", AUTOPILOTS)
def test_autopilots_and_the_tap_keep_who_and_how_high(name: str) -> None:
    check(read(CASES / "autopilots" / name, (), {}), AUTOPILOTS[name])


# --- cousins: other words, orders, separators, programs and zones ------------------------------------------------------

EPOCH = "174956400{i}"


def table(head: str, row: str, count: int = 4) -> str:
    """Rows under a header: ``{i}`` counts, ``{l}`` is the level."""
    return head + "\n" + "".join(row.format(i=i, l=-90 - i) + "\n" for i in range(count))


@pytest.mark.parametrize("name", COUSINS)
def test_cousins_are_read_as_they_say_it(name: str, tmp_path: Path) -> None:
    right = COUSINS[name]
    place = tmp_path / "table.csv"
    place.write_text(right.text, encoding=right.encoding)
    check(read(place, right.maps, right.options), right)


def climb(first: list[float], rest: float) -> str:
    heights = [*first, *[rest] * 6, *[rest + 5 * i for i in range(1, 6)]]
    return "time,lat,lon,{}\n" + "".join(f"{1749564000 + i},35.728,-78.696,{h}\n" for i, h in enumerate(heights))


@pytest.mark.parametrize(("name", "first"), [("altitude", []), ("alt_msl", []), ("alt_msl", [0.0, 0.0])])
def test_heights_count_from_the_ground_before_the_climb(name: str, first: list[float], tmp_path: Path) -> None:
    """Heights do not count from the first row or from the zeros of a receiver without a fix."""
    (tmp_path / "x.csv").write_text(climb(first, 110.0).format(name))
    shown = read(tmp_path / "x.csv", (), {}).streams[0].frame["altitude_m"].to_numpy()
    np.testing.assert_allclose(shown, [*[NAN] * len(first), *[0.0] * 6, 5, 10, 15, 20, 25])


@pytest.mark.parametrize(
    ("name", "heights", "ground"),
    [("alt_msl", [140.0] * 6 + [150, 130] + [110.0] * 6, 110.0), ("altitude", [30.0] * 6 + [40, 20] + [0.0] * 6, 0.0)],
)
def test_a_hover_at_the_start_is_no_ground(name: str, heights: list[float], ground: float, tmp_path: Path) -> None:
    """The aircraft comes down to where it then rests: that is the ground."""
    rows = "".join(f"{1749564000 + i},35.728,-78.696,{h}\n" for i, h in enumerate(heights))
    (tmp_path / "x.csv").write_text(f"time,lat,lon,{name}\n{rows}")
    shown = read(tmp_path / "x.csv", (), {}).streams[0].frame["altitude_m"].to_numpy()
    np.testing.assert_allclose(shown, np.array(heights) - ground)


BAD = yaml.load((CASES / "refused.yaml").read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
PLAN = (Path(__file__).parents[2] / "sample_logs/flight.yaml").read_text()
BAD["a plan in YAML, whose lines have equally many words"] = {"text": PLAN, "words": "settings of a flight"}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_read_is_refused_with_its_cause(name: str, tmp_path: Path) -> None:
    bad = BAD[name]
    (tmp_path / "table.csv").write_text(bad["text"], encoding=bad.get("encoding", "utf-8"))
    with pytest.raises(UsageError if "usage" in bad else InputError, match=bad["words"]):
        read(tmp_path / "table.csv", tuple(bad.get("maps", ())), bad.get("options", {}))


def test_the_summary_beside_a_log_says_its_hours_and_its_name_does_not(tmp_path: Path) -> None:
    point = '<gpx><trkpt lat="35.73" lon="-78.7"><ele>90.5</ele><time>T14:00:01Z</time></trkpt></gpx>\n'
    place = tmp_path / "25Mar02_100000.1.gpx"
    place.write_text(point)
    assert read(place, (), NEW_YORK).streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T14:00:01")
    place.with_suffix(".csv").write_text("x\nMeasurement start;2025 Mar 02 10:00\n")
    assert read(place, (), NEW_YORK).streams[0].frame["time"][0] == pd.Timestamp("2025-03-02T15:00:01")


def test_the_number_of_rank_one_is_the_users_beside_a_mapping(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("t,ri\n1749564000,0\n1749564001,3\n")
    mapped = ["--map", "t=time", "--map", "ri=ri_raw", "--ri-base", "zero"]
    assert main(["ingest", str(tmp_path / "x.csv"), *mapped, "-o", str(tmp_path / "x.h5")]) == 0
    (frame,) = frames.read(tmp_path / "x.h5").values()
    assert frame["rank"].tolist() == [1, 4]


def test_captures_of_several_frequencies_are_several_series(tmp_path: Path) -> None:
    captures = ", ".join(
        f'{{"core:sample_start": {1000 * i}, "core:datetime": "2025-06-10T14:00:0{i}Z", "core:frequency": {3.4 + i / 10}e9}}'
        for i in range(2)
    )
    meta = f'{{"global": {{"core:datatype": "ru16_le", "core:sample_rate": 1000}}, "captures": [{captures}]}}'
    (tmp_path / "x.sigmf-meta").write_text(meta)
    wave = 32_767.5 + np.where(np.arange(2000) % 2, 3276.8, -3276.8) * np.where(np.arange(2000) < 1000, 1, 0.1)
    wave.round().astype("<u2").tofile(tmp_path / "x.sigmf-data")
    result = read(tmp_path / "x.sigmf-meta", (), {})
    levels = {
        stream.name: (stream.attributes["frequency_hz"], stream.frame["rss_db"].mean()) for stream in result.streams
    }
    assert levels == {
        "USRP1_3400MHz": (3.4e9, pytest.approx(-20, abs=0.01)), "USRP1_3500MHz": (3.5e9, pytest.approx(-40, abs=0.05)),
    }  # fmt: skip


def test_tracks_of_one_time_in_a_gpx_are_two(tmp_path: Path) -> None:
    point = '<trkpt lat="35.7{t}" lon="-78.7"><ele>9{i}</ele><time>2025-06-10T14:00:0{i}Z</time></trkpt>'
    tracks = ("".join(point.format(t=t, i=i) for i in range(4)) for t in range(2))
    (tmp_path / "x.gpx").write_text("<gpx>" + "".join(f"<trk>{points}</trk>" for points in tracks) + "</gpx>")
    shown = {item.name: item.frame["latitude_deg"].tolist() for item in read(tmp_path / "x.gpx", (), {}).streams}
    assert shown == {"track_1": [35.70] * 4, "track_2": [35.71] * 4}


def test_a_table_below_in_another_form_is_no_words(tmp_path: Path) -> None:
    """Its rows are rejected, and counted, not taken for a comment."""
    below = table("time;rsrp;pci", "174956401{i};{l};12")
    (tmp_path / "x.csv").write_text(table("time,pci,rsrp", f"{EPOCH},11,{{l}}") + below)
    result = read(tmp_path / "x.csv", (), {})
    assert (result.accepted, len(result.rejected)) == (4, 4)


def test_rows_whose_identity_says_nothing_are_one_part_and_none_is_lost(tmp_path: Path) -> None:
    """Parts of one name took each other's place: ``B`` is a SIM here and a network there."""
    cells = [("A", "B"), ("", "B"), ("B", ""), ("nan", "-"), ("n/a", ""), ("", "0")]
    rows = "".join(f"{1749564000 + i},{a},{b},11,{-90 - i}\n" for i, (a, b) in enumerate(cells))
    (tmp_path / "x.csv").write_text(f"time,operator,sim slot,pci,rsrp\n{rows}")
    streams = read(tmp_path / "x.csv", (), {}).streams
    assert len({item.name for item in streams}) == len(streams)
    assert sorted(level for item in streams for level in item.frame["rss_db"]) == [-95.0, -94, -93, -92, -91, -90]


@pytest.mark.parametrize("name", ["flight.xlsx", "flight.csv"])
def test_a_spreadsheet_is_called_one(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / name, "w") as book:
        book.writestr("[Content_Types].xml", "<Types/>")
        book.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(InputError, match=r"a spreadsheet \(\.xlsx\); expected its table saved as CSV"):
        read(tmp_path / name, (), {})


def test_the_log_of_the_tap_gives_the_level_of_lte_beside_that_of_nr(tmp_path: Path) -> None:
    header = (CASES / "autopilots" / "tap_handover.jsonl").read_text().splitlines()[0]
    cell = {"pcid": 7, "arfcn": 2300, "band": 4, "rsrp_dbm": -100, "rsrq_db": -12, "rssi_dbm": -70, "sinr_raw": 15}
    asked = {
        "query": "servingcell", "status": "ok", "sent_utc_ns": 1_749_564_000 * 10**9,
        "last_utc_ns": 1_749_564_000 * 10**9,
    }  # fmt: skip
    text = json.dumps({"kind": "exchange", "n": 1, **asked, "decoded": {"lte": cell}})[:-1]
    (tmp_path / "x.jsonl").write_text(f'{header}\n{text},"crc":"{zlib.crc32(text.encode()):08x}"}}\n')
    right = {"lte_rsrp": {"rss_db": [-100.0], "rsrq_db": [-12.0], "rssi_dbm": [-70.0]}}
    check(read(tmp_path / "x.jsonl", (), {}), Right(right, about={"pci": 7, "arfcn": 2300, "rat": "lte"}))
