"""docs/formats.md shows the dictionary of columns: its tables are made of it (``python -m tests.logs.test_formats_page``).

The example names are those of programs; each must mean what the table says.
"""

import re
from collections import Counter
from pathlib import Path

import numpy as np
import yaml

from aerpaw_cmp.logs import dictionary
from aerpaw_cmp.logs.text import COUNTS

PAGE = Path(__file__).parents[2] / "docs" / "formats.md"
BEGIN, END = "<!-- dictionary: made by tests/logs/test_formats_page.py -->\n", "<!-- end of dictionary -->\n"
EXAMPLES = {
    "time": ("Timestamp", "datetime(utc)", "abs_time", "gps_time", "measured_at", "time_boot_ms"),
    "date": ("Date", "CUSTOM.date [local]"), "zone": ("Timezone", "UTC offset"), "gps_week": ("GPS week", "GWk"),
    "gps_seconds": ("GPS seconds", "tow", "GMS"), "latitude_deg": ("lat", "OSD.latitude", "GPS Latitude"),
    "longitude_deg": ("lon", "Lng", "OSD.longitude"), "grid": ("easting", "UTM_X", "north_m"),
    "accuracy": ("HDop", "gps_accuracy"), "altitude_m, take-off": ("RelHomeAlt", "relative_alt", "height_above_takeoff(feet)"),
    "altitude_m, ground": ("altitude_agl", "height above ground"),
    "altitude_m, sea level": ("altitude_msl", "Altitude (ft MSL)", "ele"),
    "altitude_m, ellipsoid": ("alt_ellipsoid", "HAE"), "altitude_m, unknown": ("alt", "Altitude [m]", "Height"),
    "roll_deg": ("roll", "Roll [rad]"), "pitch_deg": ("pitch", "pitch(degrees)"),
    "yaw_deg": ("yaw", "compass_heading(degrees)", "hdg"), "velocity_north_mps": ("VN", "vel_n_m_s", "xSpeed(mph)"),
    "velocity_east_mps": ("VE", "vel_e_m_s", "ySpeed(mph)"), "velocity_down_mps": ("VD", "vz", "zSpeed(mph)"),
    "fix": ("fix_type", "GPSFix", "gps_valid", "GPS quality"), "satellites": ("NumberOfSatellites", "satellites_used"),
    "battery_v": ("Volt", "batteryVolts"), "device": ("device_id", "IMEI", "sysid", "receiver_channel"),
    "network": ("operator", "MCC", "MNC", "SIM slot"), "technology": ("NetworkTech", "net_type", "RAT"),
    "serving": ("is_registered", "serving"), "neighbouring": ("neighboring",), "power": ("link power", "LW1"),
    "quality": ("link quality",), "SNR": ("link snr",), "rank": ("PDSCH rank (NR)", "dl_ri", "NR RI"),
    "RSRP": ("RSRP (LTE pcell)", "NR5G SS-RSRP [dBm]", "NB1_RSRP", "NRSRP1"), "RSRQ": ("rsrq(dB)", "NRxRSRQ"),
    "SINR": ("SINR", "RS SNR", "rssnr"), "RSSI": ("RSSI", "E-UTRAN carrier RSSI"), "RSCP": ("rscp",),
    "RxLev": ("RxLev",), "Ec/N0": ("ec_no",), "PCI": ("LTEPCI", "Physical cell identity", "NB1_PCI"),
    "ARFCN": ("EARFCN", "NR-ARFCN"), "CQI": ("WB CQI",), "path loss": ("Pathloss",),
    "throughput": ("Mac DL Throughput", "DL_bitrate"), "MCS": ("dl_mcs",), "BLER": ("LTE BLER [%]",),
}  # fmt: skip


def label(row: dictionary.Quantity) -> str:
    return f"{row.name}, {row.datum}" if row.datum else row.name


ROWS = {label(row): row for row in dictionary.QUANTITIES if row.role != "other"}


def table() -> str:
    lines = ["| quantity | names such as | unit | range | missing value |", "| --- | --- | --- | --- | --- |"]
    for name, row in ROWS.items():
        low, high = row.can_be
        limits = f"{low:g} .. {high:g}" if np.isfinite([low, high]).all() else ""
        names = ", ".join(f"`{example}`" for example in EXAMPLES[name])
        lines.append(f"| {name} | {names} | {row.unit} | {limits} | {', '.join(f'{value:g}' for value in row.none)} |")
    lines += [
        "",
        "| program | recognised by the columns | its heights are above | angles |",
        "| --- | --- | --- | --- |",
    ]
    for program in dictionary.PROGRAMS:
        signs = "; or ".join(", ".join(f"`{sign}`" for sign in sorted(part)) for part in program.signs[:2])
        lines.append(f"| {program.name} | {signs} | {program.datum} | {program.angles} |")
    none = ", ".join(f"{value:.0f}" for value in dictionary.UNAVAILABLE)
    units = ", ".join(f"`{unit}`" for unit in dictionary.UNITS)
    return "\n".join([*lines, "", f"Missing value in any column: {none}. Units: {units}, `ddmm.mmmm`.", ""])


def parts() -> tuple[str, str, str]:
    """The page before the tables, the tables, and behind them."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    shown, after = rest.split(END)
    return before + BEGIN, shown, END + after


def test_every_row_has_examples_that_mean_it() -> None:
    assert EXAMPLES.keys() == ROWS.keys()
    for name, examples in EXAMPLES.items():
        for example in examples:
            meaning = dictionary.meaning(example)
            assert meaning is not None, example
            assert label(meaning.quantity) == name, example


def test_the_page_shows_the_dictionary_as_it_is() -> None:
    assert parts()[1] == table(), "run python -m tests.logs.test_formats_page"


def test_no_pattern_is_hidden_by_a_row_above() -> None:
    """A row whose examples are all taken by an earlier one would never be used."""
    plain = [dictionary.plain(name) for names in EXAMPLES.values() for name in names]
    for row in ROWS.values():
        assert any(re.search(pattern, name) for pattern in row.names for name in plain), row.name


def test_every_row_of_the_file_is_used() -> None:
    """A misspelt key, role, datum or unit would be ignored, and a repeated pattern belongs to its first row."""
    source = Path(dictionary.__file__).with_name("dictionary.yaml").read_text(encoding="utf-8")
    rows = yaml.safe_load(source)["quantities"]
    assert len(rows) == len(dictionary.QUANTITIES) > 40
    keys = {"name", "role", "unit", "open_unit", "datum", "range", "missing", "names"}
    assert not [row for row in rows if not row.keys() <= keys]
    patterns = Counter(pattern for row in dictionary.QUANTITIES for pattern in row.names)
    assert not [pattern for pattern, count in patterns.items() if count > 1]
    roles = "time position grid height angle velocity count doubt identity cell rss rank kpi other"
    datums = {"", "take-off", "ground", "sea level", "ellipsoid", "unknown"}
    for row in dictionary.QUANTITIES:
        assert row.role in roles.split(), row.name
        assert row.datum in datums, row.name
        assert bool(row.datum) == (row.role == "height"), row.name
        assert row.can_be[0] < row.can_be[1], row.name


def test_words_and_units_of_programs_are_known() -> None:
    written = {"dB re full scale", "%", "index"}
    for program in dictionary.PROGRAMS:
        for pattern, word in program.words.items():
            assert re.compile(pattern).groups >= word.count("\\"), program.name
        for unit in program.units.values():
            assert unit in written or dictionary.is_unit(unit) or unit in COUNTS, program.name


if __name__ == "__main__":
    PAGE.write_text(parts()[0] + table() + parts()[2], encoding="utf-8")
