"""The source of a row: two sources never become one series without a warning, and one never becomes two."""

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aerpaw_cmp.logs.ingest import ingest
from aerpaw_cmp.logs.records import ReadResult

# Names of identities and what they write for the first, the second and the third source.
IDENTITIES = {
    "pci": ("11", "12", "500"), "cell_id": ("51200001", "51200514", "7"), "ECI": ("900", "901", "902"),
    "eNB ID": ("3001", "3002", "3003"), "sector": ("1", "2", "3"), "beam": ("0", "1", "2"), "ssb_index": ("4", "0", "2"),
    "rnti": ("f055", "6584", "17"), "antenna_port": ("0", "1", "2"), "device": ("A", "B", "C"), "IMEI": ("35", "36", "37"),
    "sim_slot": ("0", "1", "2"), "operator": ("T", "V", "A"), "transmitter": ("LW1", "LW2", "LW3"),
    "receiver": ("rx-a", "rx-b", "rx-c"), "earfcn": ("2300", "5110", "66486"), "Freq (MHz)": ("739", "2145", "3460"),
    "cgi": ("310260-1", "310260-2", "310260-3"), "bssid": ("aa:01", "aa:02", "aa:03"), "tower": ("LW1", "LW2", "LW3"),
}  # fmt: skip
# What changes along a flight, and says nothing of who.
OTHERS: dict[str, Callable[[int], str]] = {
    "waypoint": lambda i: str(i // 12), "flight_mode": lambda i: "AUTO" if i % 40 > 9 else "LOITER",
    "height_step": lambda i: str(30 + 10 * (i // 20)), "battery": lambda i: str(100 - i // 5), "armed": lambda _i: "1",
}  # fmt: skip
BASES = (-70, -95, -120)


def rows_of(sources: int, order: str, count: int, shuffle: random.Random) -> list[tuple[float, int, int]]:
    """Time, source and number of each reading: at the same times, in turns, or a source after the other."""
    if order == "turns":
        return [(i * 0.3, i % sources, i // sources) for i in range(count * sources)]
    if order == "blocks":
        return [(float(i), i // 20 % sources, i) for i in range(count * sources)]
    rows = []
    for i in range(count):
        group = [(float(i), source, i) for source in range(sources)]
        shuffle.shuffle(group)
        rows += group
    return rows


def written(names: list[str], rows: list[tuple[float, int, int]]) -> str:
    lines = []
    for at, (time, source, number) in enumerate(rows):
        cells = {"timestamp": f"{1749564000 + time:.1f}", "rsrp": f"{BASES[source] - number % 4}"}
        cells |= {name: values[source] for name, values in IDENTITIES.items()}
        cells |= {name: value(at) for name, value in OTHERS.items()}
        cells |= {f"{name} copy": values[source] for name, values in IDENTITIES.items()}
        lines.append(",".join(cells[name] for name in names))
    return ",".join(names) + "\n" + "\n".join(lines) + "\n"


def read(path: Path, text: str) -> ReadResult:
    path.write_text(text)
    (file,) = ingest([path])
    return file.result


def sources_of(result: ReadResult) -> list[set[int]]:
    """Sources in each series of levels."""
    return [
        {round((-70 - level - 2) / 25) for level in stream.frame["rss_db"].dropna()}
        for stream in result.streams
        if stream.kind == "rss"
    ]


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_the_series_are_the_sources(data: st.DataObject, tmp_path: Path) -> None:
    sources = data.draw(st.integers(1, 3))
    known = data.draw(st.lists(st.sampled_from(sorted(IDENTITIES)), min_size=1, max_size=3, unique=True))
    twice = [f"{known[0]} copy"] if data.draw(st.booleans()) else []
    more = data.draw(st.lists(st.sampled_from(sorted(OTHERS)), max_size=3, unique=True))
    names = data.draw(st.permutations(["timestamp", "rsrp", *known, *twice, *more]))
    rows = rows_of(sources, data.draw(st.sampled_from(["turns", "blocks", "at once"])), 40, data.draw(st.randoms()))
    found = sources_of(read(tmp_path / "x.csv", written(names, rows)))
    assert all(len(part) == 1 for part in found), (names, found)
    assert sorted(next(iter(part)) for part in found) == list(range(sources)), (names, found)


@pytest.mark.parametrize("order", ["turns", "at once"])
@pytest.mark.parametrize("sources", [2, 3])
def test_sources_that_no_column_names_are_reported(order: str, sources: int, tmp_path: Path) -> None:
    rows = rows_of(sources, order, 40, random.Random(1))
    result = read(tmp_path / "x.csv", written(["timestamp", "rsrp", "waypoint"], rows))
    assert any("its levels alternate" in text for text in result.warnings)


@pytest.mark.parametrize("name", ["unit", "probe", "who"])
@pytest.mark.parametrize("order", ["turns", "at once"])
def test_a_column_of_an_unknown_name_that_takes_turns_with_the_level_joins_the_key(
    name: str, order: str, tmp_path: Path
) -> None:
    rows = rows_of(3, order, 40, random.Random(1))
    text = written(["timestamp", "operator copy", "rsrp"], rows).replace("operator copy", name)
    found = sources_of(read(tmp_path / "x.csv", text))
    assert sorted(map(sorted, found)) == [[0], [1], [2]]


@pytest.mark.parametrize("order", ["turns", "blocks", "at once"])
@pytest.mark.parametrize("name", [
    "station", "sensor_id", "Source ID", "src_node", "mac_addr", "neighbor", "Neighbour cell", "serving_cell", "satellite",
])  # fmt: skip
def test_a_name_of_a_source_divides_the_levels(name: str, order: str, tmp_path: Path) -> None:
    """Serving cell and satellite may also be a state and a count: here they are names."""
    values = {"transmitter": ("G07", "G12", "R03")}
    rows = rows_of(3, order, 40, random.Random(1))
    text = written(["timestamp", "transmitter", "rsrp"], rows).replace("transmitter", name)
    for old, new in zip(IDENTITIES["transmitter"], values["transmitter"], strict=True):
        text = text.replace(old, new)
    assert sorted(map(sorted, sources_of(read(tmp_path / "x.csv", text)))) == [[0], [1], [2]]


@pytest.mark.parametrize("name", ["pci", "eNB ID", "cell_id", "sim_slot", "rnti", "earfcn", "station"])
def test_numbers_with_a_decimal_are_the_same_sources(name: str, tmp_path: Path) -> None:
    """Pandas writes the integers of a column with missing values as 11.0."""
    rows = [f"{-70 - 25 * (i % 2)},{(11, 12)[i % 2]}{'.0' if i > 9 else ''}" for i in range(40)]
    assert levels_by_cell(tmp_path / "x.csv", f"rsrp,{name}", rows) == [[-95], [-70]]


@pytest.mark.parametrize("name", ["is_serving", "Serving Cell", "neighbour", "satellites"])
def test_a_state_or_a_count_does_not_divide_the_levels(name: str, tmp_path: Path) -> None:
    rows = [f"-70,{(9 + i // 10) if name == 'satellites' else i // 10 % 2}" for i in range(40)]
    assert levels_by_cell(tmp_path / "x.csv", f"rsrp,{name}", rows) == [[-70]]


@pytest.mark.parametrize("seed", range(8))
def test_numbers_in_an_unknown_column_are_reported_if_they_may_be_cells(seed: int, tmp_path: Path) -> None:
    """A handover is one change. Waypoints are consecutive, heights are round."""
    chance, count = random.Random(seed), 60
    name = "x" + "".join(chance.choice("bcdfghjklmnpqrstvwxz") for _ in range(5))
    cells = [chance.randrange(100) * 4 + 1 + 400 * i for i in range(chance.randrange(2, 5))]
    for numbers, asked in ((cells, True), (range(1, 5), False), (range(30, 70, 10), False)):
        rows = "".join(f"{1749564000 + i},{numbers[i * len(numbers) // count]},{-80 - i % 7}\n" for i in range(count))
        warnings = read(tmp_path / "x.csv", f"time,{name},rsrp\n{rows}").warnings
        assert any(f"not read: '{name}'" in text for text in warnings) is asked, (numbers, warnings)


@pytest.mark.parametrize("shared", ["", "pci"])
@pytest.mark.parametrize("name", ["id", "unit", "cc", "SCell", "chain", "sduid"])
def test_numbers_that_change_once_are_reported_if_the_name_may_be_that_of_a_source(
    name: str, shared: str, tmp_path: Path
) -> None:
    """Two units in turn can receive one cell, so a PCI in the table does not answer the question."""
    rows = "".join(f"{1749564000 + i},211,{1 + (i >= 30)},{-80 - i % 7}\n" for i in range(60))
    warnings = read(tmp_path / "x.csv", f"time,{shared or 'x'},{name},rsrp\n{rows}").warnings
    assert any(f"not read: '{name}'" in text for text in warnings), warnings


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("in_turns", [True, False])
def test_names_in_an_unknown_column_divide_the_levels_or_are_reported(
    seed: int, in_turns: bool, tmp_path: Path
) -> None:
    """Levels of equal sources show nothing, and a handover is a single change."""
    chance, count = random.Random(seed), 40
    name = "x" + "".join(chance.choice("bcdfghjklmnpqrstvwxz") for _ in range(5))
    values = [f"{chance.choice('ABC')}{chance.randrange(100)}-{i}" for i in range(chance.randrange(2, 6))]
    sources = [values[i % len(values) if in_turns else i * len(values) // count] for i in range(count)]
    rows = "".join(f"{1749564000 + i},{source},{-80 - i % 7}\n" for i, source in enumerate(sources))
    result = read(tmp_path / "x.csv", f"time,{name},rsrp\n{rows}")
    divided = sum(stream.kind == "rss" for stream in result.streams) == len(values)
    assert divided or any(f"not read: '{name}'" in text for text in result.warnings), result.warnings


def test_rows_whose_identity_is_empty_are_no_part_of_another(tmp_path: Path) -> None:
    rows = "".join(f"{1749564000 + i},{'' if i % 2 else 'A'},{-70 - 40 * (i % 2)}\n" for i in range(20))
    levels = [set(s.frame["rss_db"]) for s in read(tmp_path / "x.csv", f"time,operator,rsrp\n{rows}").streams]
    assert levels == [{-70.0}, {-110.0}]


def test_a_series_has_the_name_of_its_source_and_a_number_that_of_its_column(tmp_path: Path) -> None:
    rows = "".join(f"{1749564000 + i},{'7' if i % 2 else 'A1'},{-70 - 40 * (i % 2)}\n" for i in range(20))
    names = [stream.name for stream in read(tmp_path / "x.csv", f"time,tower,rsrp\n{rows}").streams]
    assert names == ["rsrp_A1", "rsrp_tower7"]


def test_a_column_of_an_unknown_name_whose_values_alternate_without_turns_is_asked_about(tmp_path: Path) -> None:
    """A second source is 12 dB lower, at random between the rows of the first. A waypoint is not a source."""
    chance = random.Random(3)
    rows = [
        (1749564000 + i, source := chance.randrange(2), -70 - 12 * source - chance.random(), i // 10) for i in range(80)
    ]
    text = "".join(f"{time},{'ab'[source]},{level:.1f},{leg}\n" for time, source, level, leg in rows)
    warnings = read(tmp_path / "x.csv", f"time,box,rsrp,leg\n{text}").warnings
    assert (
        [text for text in warnings if "does it name the device or cell" in text]
        == [text for text in warnings if text.startswith("column 'box'")]
        != []
    )


@pytest.mark.parametrize(
    "form", ["Top{} {q}", "{q} Top{}", "Cell {} {q}", "{q}({})", "cell{}_{q}", "Scan #{} {q} [dBm]", "{} best {q}"]
)
@pytest.mark.parametrize("words", [("1", "2"), ("A", "B"), ("First", "Last")])
def test_an_identity_is_that_of_the_level_whose_other_words_it_shares(
    form: str, words: tuple[str, str], tmp_path: Path
) -> None:
    """A scan sorts its cells by level, so that the columns of each cell change from row to row."""
    names = [form.format(word, q=quantity) for word in words for quantity in ("PCI", "RSRP")]
    names = [name.replace("PCI [dBm]", "PCI") for name in names]
    rows = [(f"{1749564000 + i}", *(("11,-70", "12,-95") if i % 3 else ("12,-68", "11,-71"))) for i in range(30)]
    text = f"timestamp,{','.join(names)}\n" + "\n".join(",".join(row) for row in rows) + "\n"
    levels = {
        stream.attributes["pci"]: len(stream.frame["rss_db"].dropna())
        for stream in read(tmp_path / "x.csv", text).streams if stream.kind == "rss"
    }  # fmt: skip
    assert levels == {11: 30, 12: 30}


def levels_by_cell(path: Path, names: str, rows: list[str]) -> list[list[float]]:
    """Distinct levels of each series, in order."""
    text = f"timestamp,{names}\n" + "".join(f"{1749564000 + i},{row}\n" for i, row in enumerate(rows))
    return sorted(sorted(set(s.frame["rss_db"].dropna())) for s in read(path, text).streams if s.kind == "rss")


@pytest.mark.parametrize(("first", "second", "quantity"), [
    ("CID_1", "CID_2", "RSRP_{}"), ("eNB1", "eNB2", "RSRP{}"), ("BSSID 1", "BSSID 2", "RSSI {}"),
    ("AP1", "AP2", "RSSI{}"), ("Top1 ECI", "Top2 ECI", "Top{} RSRP"), ("SSID_1", "SSID_2", "RSSI_{} (dBm)"),
    ("Tower 1 ID", "Tower 2 ID", "Tower {} RSRP"), ("Beam 1", "Beam 2", "RSRP {}"), ("CID", "CID_2", "RSRP_{}"),
])  # fmt: skip
@pytest.mark.parametrize("cells", [("51200001", "51200514"), ("lab", "roof")])
def test_an_identity_other_than_a_pci_belongs_to_its_level(
    first: str, second: str, quantity: str, cells: tuple[str, str], tmp_path: Path
) -> None:
    names = f"{first},{quantity.format(1)},{second},{quantity.format(2)}"
    names = names.replace("RSRP_1", "RSRP") if first == "CID" else names
    a, b = cells
    rows = [f"{a},-70,{b},-95" if i % 3 else f"{b},-94,{a},-71" for i in range(30)]
    assert levels_by_cell(tmp_path / "x.csv", names, rows) == [[-95, -94], [-71, -70]]
    rows = [f",-50,{b},-95" if i % 3 else f"{b},-94,,-52" for i in range(30)]  # neither is the same cell for sure
    assert levels_by_cell(tmp_path / "x.csv", names, rows) == [[-95, -94], [-52], [-50]]


@pytest.mark.parametrize(("names", "rows"), [
    ("PCI_1,CID_1,RSRP_1,PCI_2,CID_2,RSRP_2", ("11,501,-70,11,502,-95", "11,502,-94,11,501,-71")),
    ("eNB 1,Sector 1,RSRP 1,eNB 2,Sector 2,RSRP 2", ("31,1,-70,31,2,-95", "31,2,-94,31,1,-71")),
    ("PCI A,RSSI A,PCI B,RSSI B", ("11,-70,12,-95", "12,-94,11,-71")),
    ("serving_cid,serving_rsrp,neighbor_cid,neighbor_rsrp", ("501,-70,502,-95", "502,-94,501,-71")),
    ("Source PCI,Source RSRP,Target PCI,Target RSRP", ("11,-70,12,-95", "12,-94,11,-71")),
    ("Source PCI,RSRP,Target PCI,Target RSRP", ("11,-70,12,-95", "12,-94,11,-71")),
    ("source_cid,source_rsrp,target_cid,target_rsrp", ("501,-70,502,-95", "502,-94,501,-71")),
])  # fmt: skip
def test_all_identities_of_a_level_count(names: str, rows: tuple[str, str], tmp_path: Path) -> None:
    found = levels_by_cell(tmp_path / "x.csv", names, [rows[i % 3 == 0] for i in range(30)])
    assert found == [[-95, -94], [-71, -70]]


@pytest.mark.parametrize("name", [
    "Target RSRP", "model RSRP", "RSRP ref", "expected_rsrp", "rsrp_rt", "rsrp_sim", "RSRP (ray tracing)", "rsrpFspl",
])  # fmt: skip
def test_a_level_of_a_model_without_an_identity_is_not_a_level(name: str, tmp_path: Path) -> None:
    rows = [f"11,-70,{-95 - i}" for i in range(30)]
    assert levels_by_cell(tmp_path / "x.csv", f"PCI,RSRP,{name}", rows) == [[-70]]


@pytest.mark.parametrize(
    "name", ["Reference Signal Received Power (RSRP)", "Tower RSRP", "Antenna RSRP", "Payload RSRP"]
)
def test_words_of_gimbals_and_towers_do_not_hide_a_level(name: str, tmp_path: Path) -> None:
    assert levels_by_cell(tmp_path / "x.csv", f"PCI,{name}", ["11,-70"] * 30) == [[-70]]


@pytest.mark.parametrize("names", ["rssi,link_quality,x,y", "1RSS(dB),RQly(%),RSNR(dB),ANT"])
def test_a_share_of_packets_is_no_level_and_the_antenna_in_use_no_source(names: str, tmp_path: Path) -> None:
    rows = [f"{-70 - 2 * (i // 5 % 2)},100,9,{i % 2}" for i in range(30)]
    assert levels_by_cell(tmp_path / "x.csv", names, rows) == [[-72, -70]]


@pytest.mark.parametrize("level", [lambda i: -70 - i % 5, lambda i: -70 - 20 * (i * i % 11 % 2)])
def test_a_temperature_in_rows_of_one_second_is_no_source_and_a_name_is_one(
    level: Callable[[int], int], tmp_path: Path
) -> None:
    """The stamps have whole seconds. A name whose level stays while others differ names a source."""
    lines = [f"{1749564000 + i // 10},11,{level(i)},{i * i % 11}" for i in range(200)]
    result = read(tmp_path / "x.csv", "timestamp,pci,rsrp,spot\n" + "\n".join(lines) + "\n")
    asked = any("'spot'" in text and "does it name the device" in text for text in result.warnings)
    assert ([stream.rows for stream in result.streams] == [200]) is asked is (level(1) == -71)


@pytest.mark.parametrize("name", ["rsrp_sim", "rsrp_lstm", "prev_rsrp", "rsrp_scaled", "rsrp_peak", "xq_rsrp"])
@pytest.mark.parametrize("own", ["rsrp", "RSRP [dBm]", "rsrp_raw"])
def test_the_plain_name_of_a_level_wins(name: str, own: str, tmp_path: Path) -> None:
    """A simulated level has more distinct values than a measured one."""
    rows = [f"11,{-95 - 0.37 * i},{-70 - i % 2}" for i in range(30)]
    text = f"timestamp,pci,{name},{own}\n" + "".join(f"{1749564000 + i},{row}\n" for i, row in enumerate(rows))
    (level,) = (stream for stream in read(tmp_path / "x.csv", text).streams if stream.name == "pci11")
    assert set(level.frame["rss_db"]) == {-70, -71}


@pytest.mark.parametrize("name", ["technology", "rat", "network"])
@pytest.mark.parametrize("level", ["rsrp", "rssi_dbm"])
def test_levels_of_two_radio_accesses_are_two_series(name: str, level: str, tmp_path: Path) -> None:
    rows = [f"{'LTE' if i < 20 else 'NR'},{-70 if i < 20 else -95}" for i in range(40)]
    assert levels_by_cell(tmp_path / "x.csv", f"{name},{level}", rows) == [[-95], [-70]]


@pytest.mark.parametrize(
    ("name", "values"), [("MS", "A1 B2"), ("id", "1 2"), ("cc", "0 1"), ("radio", "A1 B2"), ("source", "A1 B2")]
)
def test_short_names_are_asked_about(name: str, values: str, tmp_path: Path) -> None:
    rows = "".join(f"{1749564000 + i},{values.split()[i // 20]},{-80 - i % 7}\n" for i in range(40))
    result = read(tmp_path / "x.csv", f"time,{name},rsrp\n{rows}")
    assert any(f"'{name}'" in text for text in result.warnings) or len(result.streams) == 2


@pytest.mark.parametrize("names", ["cell_id,rsrp,nr_cell_id,nr_pci,nr_rsrp", "nr_pci,nr_rsrp,nr_cell_id,cell_id,rsrp"])
def test_the_number_of_an_lte_cell_does_not_divide_the_levels_of_nr(names: str, tmp_path: Path) -> None:
    """A phone on both: one LTE handover, no NR handover. Without LTE, the number of an NR cell divides its levels."""
    cells = {"rsrp": "-70", "nr_cell_id": "900", "nr_pci": "501", "nr_rsrp": "-95"}
    rows = [",".join((cells | {"cell_id": str(51 + i // 20)})[name] for name in names.split(",")) for i in range(40)]
    assert levels_by_cell(tmp_path / "x.csv", names, rows) == [[-95], [-70], [-70]]
    rows = [f"501,{900 + i // 20},{-70 - i // 20}" for i in range(40)]
    assert levels_by_cell(tmp_path / "x.csv", "nr_pci,nr_cell_id,nr_rsrp", rows) == [[-71], [-70]]
