"""Archives and folders of pieces: read as folders, bounded, members named like files."""

import gzip
import io
import struct
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from aerpaw_cmp.common.errors import InputError
from aerpaw_cmp.logs import files as archives
from aerpaw_cmp.logs.flight_file import write_flight
from aerpaw_cmp.logs.ingest import ingest
from tests.parsers.samples import FILES, IQ_NAME, NO_LOGS, OPTIONS, iq_mat

CONTENT = {
    "set/UAV/x_vehicleOut.txt": FILES["vehicle_out/ten_fields"], "set/LW1/x_power_log.txt": FILES["sounder_log/runs_and_foot"],
    "set/LW1/x_power_log.txt.gz": gzip.compress(FILES["sounder_log/runs_and_foot"]), "set/phone.nmfs": NO_LOGS["nemo_binary"],
    "__MACOSX/set/._x": b"junk",
}  # fmt: skip


def zipped(content: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as book:
        for name, data in content.items():
            book.writestr(name, data)
    return file.getvalue()


def tarred(content: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as book:
        for name, data in content.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            book.addfile(info, io.BytesIO(data))
    return file.getvalue()


@pytest.mark.parametrize("pack", [zipped, tarred, lambda content: gzip.compress(tarred(content))])
def test_an_archive_gives_what_its_folder_gives(tmp_path: Path, pack: object) -> None:
    for name, data in CONTENT.items():
        (tmp_path / "folder" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "folder" / name).write_bytes(data)
    archive = tmp_path / "set.pack"
    archive.write_bytes(pack(CONTENT))  # type: ignore[operator]
    packed, plain = ingest(archive, options=OPTIONS), ingest(tmp_path / "folder" / "set", options=OPTIONS)
    assert [Path(f.path).name for f in packed] == [Path(f.path).name for f in plain]
    for member, file in zip(packed, plain, strict=True):
        assert member.result.streams[0].frame.equals(file.result.streams[0].frame)
    assert [s.reason for s in packed.skipped] == [s.reason for s in plain.skipped]
    assert "nmfs" in packed.skipped[0].path
    (again,) = ingest(archive / "set/LW1/x_power_log.txt", options=OPTIONS)
    assert again.result.accepted == 6


def test_a_missing_member_and_a_damaged_archive_are_messages(tmp_path: Path) -> None:
    place = tmp_path / "a.zip"
    place.write_bytes(zipped(CONTENT))
    with pytest.raises(InputError, match="no member"):
        ingest(place / "set/none.txt")
    place.write_bytes(zipped(CONTENT)[:-40])
    with pytest.raises(InputError, match="damaged archive"):
        ingest(place)
    place.write_bytes(zipped(CONTENT)[:60] + zipped(CONTENT)[-100:])  # a directory that begins before the file does
    with pytest.raises(InputError, match="damaged archive"):
        ingest(place)
    intact = zipped(CONTENT)
    at = intact.index(b"x_vehicleOut.txt") + 40
    place.write_bytes(intact[:at] + b"\xff\xff\xff" + intact[at + 3 :])
    assert any("damaged" in s.reason for s in ingest(place, options=OPTIONS).skipped)


def test_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archives, "_MARGIN", 1000)
    data = zipped({"a.txt": b"\0" * 3_000_000, "b_vehicleOut.txt": FILES["vehicle_out/ten_fields"]})
    lied = bytearray(data)
    at = lied.rindex(b"PK\x01\x02", 0, lied.rindex(b"b_vehicleOut.txt") - 46)  # central entry of a.txt
    lied[at + 24 : at + 28] = struct.pack("<I", 4_000_000_000)
    place = tmp_path / "bomb.zip"
    place.write_bytes(bytes(lied))
    ingested = ingest(place, options=OPTIONS)
    assert [Path(f.path).name for f in ingested] == ["b_vehicleOut.txt"]
    assert "unpacks to" in ingested.skipped[0].reason
    monkeypatch.setattr(archives, "MOST_MEMBERS", 1)
    with pytest.raises(InputError, match="contains 2 files"):
        ingest(place)


def test_an_archive_that_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = {f"m{i}.txt": b"\0" * 400_000 for i in range(10)} | {"x_vehicleOut.txt": FILES["vehicle_out/ten_fields"]}
    place = tmp_path / "many.zip"
    place.write_bytes(zipped(content))
    assert [Path(f.path).name for f in ingest(place, options=OPTIONS)] == ["x_vehicleOut.txt"]
    monkeypatch.setattr(archives, "_FREE_BYTES", 1000)
    with pytest.raises(InputError, match=r"unpacks to 40\d+ bytes"):
        ingest(place, options=OPTIONS)


def test_what_the_first_bytes_show_to_be_no_log_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "a.zip"
    place.write_bytes(zipped({"junk.bin": b"\0" * 5_000_000, "x_vehicleOut.txt": FILES["vehicle_out/ten_fields"]}))
    unpacked: list[tuple[str, int | None]] = []
    plain = archives._unzipped

    def noted(book: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, most: int | None) -> bytes:
        unpacked.append((entry.filename, most))
        return plain(book, entry, path, most)

    monkeypatch.setattr(archives, "_unzipped", noted)
    assert len(ingest(place, options=OPTIONS)) == 1
    assert ("x_vehicleOut.txt", None) in unpacked
    assert ("junk.bin", None) not in unpacked


def test_names_of_members_stay_in_the_archive(tmp_path: Path) -> None:
    place = tmp_path / "a.zip"
    place.write_bytes(
        zipped(
            {
                "/etc/x_vehicleOut.txt": FILES["vehicle_out/ten_fields"],
                "../../y_vehicleOut.txt": FILES["vehicle_out/ten_fields"],
            }
        )
    )
    ingested = ingest(place, options=OPTIONS)
    assert [f.path for f in ingested] == [str(place / "etc/x_vehicleOut.txt")]
    assert "the member's name leaves the archive" in ingested.skipped[0].reason
    (again,) = ingest(place / "etc/x_vehicleOut.txt", options=OPTIONS)
    assert again.result.accepted == ingested[0].result.accepted


def test_an_archive_in_an_archive_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(
        zipped({"inner.zip": zipped(CONTENT), "x_vehicleOut.txt": FILES["vehicle_out/ten_fields"]})
    )
    assert "unpack it" in ingest(tmp_path / "a.zip", options=OPTIONS).skipped[0].reason


def test_a_folder_of_bursts_is_one_log(tmp_path: Path) -> None:
    folder = tmp_path / "bursts"
    folder.mkdir()
    for i in range(30):
        file = io.BytesIO()
        scipy.io.savemat(file, {"IQ": np.full((1, 50), 10 ** (-i / 20), dtype=np.complex64)})
        (folder / IQ_NAME.replace("00_250", f"{i:02d}_250")).write_bytes(file.getvalue())
    (tmp_path / "x_vehicleOut.txt").write_bytes(FILES["vehicle_out/ten_fields"])
    bursts, track = ingest(tmp_path, options=OPTIONS)
    assert (bursts.path, bursts.result.reader) == (str(folder), "iq_burst")
    (stream,) = bursts.result.streams
    # read as dBm here: 0 dBm is received nowhere, and flagged
    assert stream.frame["rss_db"].tolist()[1:] == pytest.approx([-float(i) for i in range(1, 30)], abs=1e-4)
    assert bursts.result.lines == bursts.result.accepted == 30
    assert track.result.reader == "vehicle_out"
    (again,) = ingest(folder, options=OPTIONS)
    assert again.sha256 == bursts.sha256


def test_a_single_burst_is_read_alone(tmp_path: Path) -> None:
    (tmp_path / IQ_NAME).write_bytes(iq_mat())
    (burst,) = ingest(tmp_path, options=OPTIONS)
    assert burst.path.endswith(IQ_NAME)


def test_a_flight_file_gives_its_logs_back(tmp_path: Path) -> None:
    (tmp_path / "n.csv").write_bytes(FILES["nemo_csv/table"])
    files = ingest(tmp_path / "n.csv", options=OPTIONS)
    write_flight(tmp_path / "flight.h5", files)
    (again,) = ingest(tmp_path / "flight.h5")
    assert again.sha256 == files[0].sha256
    assert again.result.streams[0].frame.equals(files[0].result.streams[0].frame)
