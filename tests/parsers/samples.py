"""Synthetic samples of every format in several encodings. None is taken from a real log.

``sample_files/`` contains the text formats byte by byte: one folder per reader, and one folder of files that are not logs.
``accounts.csv`` contains the expected numbers of accepted and rejected lines.
"""

import csv
import io
import zlib
from pathlib import Path

import h5py
import numpy as np
import scipy.io

from aerpaw_cmp.logs.readers import ReadOptions
from tests.parsers import autopilots

FOLDER = Path(__file__).with_name("sample_files")
FILES = {path.relative_to(FOLDER).with_suffix("").as_posix(): path.read_bytes() for path in FOLDER.rglob("*.*")}

OPTIONS = ReadOptions(
    timezone="America/New_York", time_origin="2025-03-02T15:00:00Z", kind="rss",
    columns={"time": "Time", "rss_db": "Level"}, unit="dBm",
    file_name="results_3320000000.0_2000000.0_2025_03_02_10_00_00_250.mat",
)  # fmt: skip


def sounder_log(count: int) -> bytes:
    """Return a power log with this number of samples, with a run of '*', a jump and a silent sample."""
    out, offset = [], 0
    for i in range(count):
        stamp = f"[2025-03-02 10:{i // 1500:02d}:{i // 25 % 60:02d}.{i % 25 * 40000:06d}]"
        if i % 40 == 17:
            out.append(f"{stamp} *")
            offset += 12
            continue
        offset += 44 if i % 97 == 96 else 4
        out.append(f"{stamp} {offset:07o} {-788.5956 if i % 50 == 9 else -40 - i % 13:15.4f}")
    return ("\n".join(out) + "\n").encode()


def saved(table: dict[str, object], *, compressed: bool = True) -> bytes:
    """A MATLAB 5 file without the time of its writing: the same bytes every time."""
    file = io.BytesIO()
    scipy.io.savemat(file, table, do_compression=compressed)
    return b"MATLAB 5.0 MAT-file".ljust(116) + file.getvalue()[116:]


def mat_flight(**changes: object) -> bytes:
    """Return a merged flight of five rows and two channels, whose epoch is the local wall clock."""
    count = 5
    wall = np.datetime64("2025-03-02T10:00:00.250") + np.arange(count) * np.timedelta64(260, "ms")
    table: dict[str, object] = {
        "mX": np.linspace(-78.700, -78.699, count)[:, None], "mY": np.linspace(35.730, 35.731, count)[:, None],
        "mZ": np.linspace(0.5, 40.5, count)[:, None], "mRoll": np.full((count, 1), 1.0),
        "mPitch": np.full((count, 1), -3.0), "mYaw": np.linspace(350.0, 370.0, count)[:, None] % 360,
        "mSpeedX": np.full((count, 1), 2.0), "mpower1": np.array([-40.0, -41.0, -800.0, -43.0, -44.0])[:, None],
        "mpower2": np.linspace(-45.0, -46.0, count)[:, None],
        "timestamp_power": (wall.astype(np.int64) / 1e3)[:, None],
        "timestamp_power_for_csv": np.array([str(time).replace("T", " ") for time in wall]),
    }  # fmt: skip
    table.update(changes)
    return saved({name: value for name, value in table.items() if value is not None})


def lte_flight() -> bytes:
    """An LTE flight as its authors merged it: raw positions of another length in front, text local, epoch UTC."""
    count = 5
    seconds = 1740927600.25 + 0.1 * np.arange(count)
    table = {
        "GPSx": np.full((2, 1), -78.7), "GPSy": np.full((2, 1), 35.73),
        "mX": np.linspace(-78.700, -78.699, count)[:, None], "mY": np.linspace(35.730, 35.731, count)[:, None],
        "mZ": np.linspace(0.5, 40.5, count)[:, None], "RSRP": np.array([[17.5, 17.25, np.nan, -150.0, 16.5]]),
        "RSRP2": np.array([[17.5, 17.25, -60.0, -150.0, 16.5]]), "RSSI": np.full((1, count), 31.5),
        "succes": np.array([[1.0, 1.0, 0.0, 1.0, 1.0]]),
        "RSRQ": np.full((1, count), -6.5),
        "timestamp_for_csv": np.array([f"2025-03-02 10:00:00.{250 + 100 * i:03d}" for i in range(count)]),
        "timestamp_meas": seconds[:, None],
    }  # fmt: skip
    return saved(table)


def processed_flight() -> bytes:
    """Return a log as the authors of the LTE flights publish it: no clock, heading in radians, other tables."""
    table = {
        "RSRP_s": np.linspace(-80.0, -90.0, 4)[:, None], "acceler_s": np.zeros((4, 1)), "azim_s": np.zeros((4, 1)),
        "elev_s": np.zeros((4, 1)), "height_s": np.full((4, 1), 30.0), "lat_s": np.full((4, 1), 35.73),
        "lon_s": np.full((4, 1), -78.70), "ori_s": np.full((4, 1), np.pi / 2), "x_f": np.zeros((9, 1)),
    }  # fmt: skip
    return saved(table)


def mat_73() -> bytes:
    """The merged flight of :func:`mat_flight` as MATLAB 7.3 writes it: HDF5 behind 512 bytes, arrays transposed."""
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=512) as book:
        for name, values in scipy.io.loadmat(io.BytesIO(mat_flight())).items():
            if name.startswith("__"):
                continue
            text = values.dtype.kind == "U"
            stored = np.array([[ord(c) for c in row] for row in values.tolist()], dtype=np.uint16) if text else values
            book.create_dataset(name, data=stored.T).attrs["MATLAB_class"] = np.bytes_("char" if text else "double")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return head.ljust(512, b"\0") + file.getvalue()[512:]


def iq_mat() -> bytes:
    """A burst of two channels with amplitudes 0.1 and 0.01."""
    phase = np.exp(1j * np.linspace(0, 20, 400))
    table = {"IQ": np.array([0.1 * phase, 0.01 * phase]).astype(np.complex64), "time_stamp": np.zeros((2, 1))}
    return saved(table, compressed=False)


IQ_NAME = "results_3320000000.0_2000000.0_2025_03_02_10_00_00_250.mat"
TAP_TIMES = '"sent_utc_ns":1740927600{0}0000000,"last_utc_ns":1740927600{0}4000000'


def tap_line(text: str) -> bytes:
    """A record of the tap with its checksum."""
    return f'{text},"crc":"{zlib.crc32(text.encode()):08x}"}}\n'.encode()


# Samples by reader and name: bytes, accepted lines, rejected lines.
SAMPLES: dict[str, dict[str, tuple[bytes, int, int]]] = {
    "flight_mat": {
        "two_channels": (mat_flight(), 5, 0),
        "lte": (lte_flight(), 5, 0),
        "processed": (processed_flight(), 4, 0),
        "version_73": (mat_73(), 5, 0),
    },
    "iq_burst": {"two_channels": (iq_mat(), 1, 0)},
    "ardupilot_bin": {"flight": (autopilots.dataflash(), 5, 0)},
    "mavlink_tlog": {"version_2": (autopilots.tlog(2), 5, 0), "version_1": (autopilots.tlog(1), 5, 0)},
    "px4_ulog": {"flight": (autopilots.ulog(), 5, 0)},
}
for _row in csv.DictReader(FILES["accounts"].decode().splitlines()):
    _reader, _name = _row["sample"].split("/")
    _account = (FILES[_row["sample"]], int(_row["accepted"]), int(_row["rejected"]))
    SAMPLES.setdefault(_reader, {})[_name] = _account
# A sample of each kind of file that is not a log (except MATLAB files).
NO_LOGS = {name.removeprefix("no_logs/"): data for name, data in FILES.items() if name.startswith("no_logs/")}
# Formats whose account counts rows, values or messages.
BINARY = ("flight_mat", "iq_burst", "sigmf", "ardupilot_bin", "mavlink_tlog", "px4_ulog")
CASES = [(reader, name) for reader, samples in SAMPLES.items() for name in samples]

# Readers and samples whose clock is UTC or relative.
WITHOUT_ZONE: tuple[str | tuple[str, str], ...] = (
    "nemo_csv", "nemo_kml", "tap_jsonl", "pawprints", "srsran_json", "nmea", "rtklib_pos",
    "ardupilot_bin", "mavlink_tlog", "px4_ulog",
    ("vehicle_out", "utc_offset"), ("flight_mat", "lte"), ("flight_mat", "processed"), ("gpx", "track"),
    ("drive_test", "srsue_metrics"), ("pose_csv", "airdata"), ("srsran_gnb", "log"), ("oai_log", "frames"), ("oai_log", "ue"),
)  # fmt: skip
