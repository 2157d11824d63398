"""Where outcomes are kept: a folder, ``file://`` and a real S3 server answer alike; what is missing is named."""

from __future__ import annotations

import builtins
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs import place as places
from aerpaw_cmp.jobs.campaign_tasks import Outcome, outcome_store
from aerpaw_cmp.jobs.place import Folder, ObjectStore, Place, check_place, open_place
from aerpaw_cmp.report.campaign_data import FlownTrack

pytestmark = pytest.mark.usefixtures("few_pictures")

BUCKET = "season"


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """Address of a local S3 server (moto), with one bucket; other processes would reach it as well."""
    pytest.importorskip("s3fs", reason="s3fs is not installed (extra 'dev')")
    server_of = pytest.importorskip("moto.server", reason="moto is not installed (extra 'dev')")
    server = server_of.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    address = f"http://{host}:{port}"
    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "testing")
        patch.setenv("AWS_ENDPOINT_URL", address)
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        import boto3

        boto3.client("s3").create_bucket(Bucket=BUCKET)
        yield address
    server.stop()


@pytest.fixture(params=["folder", "file", "s3", "memory"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "s3":
        request.getfixturevalue("s3")
    else:
        pytest.importorskip("fsspec") if request.param == "memory" else None
    name = tmp_path.name
    where = {
        "folder": str(tmp_path / "deep" / "er"),
        "file": (tmp_path / "by url").as_uri(),
        "s3": f"s3://{BUCKET}/{name}",
        "memory": f"memory://{name}",
    }
    return open_place(where[request.param])


def test_what_is_written_comes_back_and_what_is_not_there_is_none(place: Place) -> None:
    check_place(place)
    assert place.names() == set()
    assert place.read("a.npz") is None
    place.write("a.npz", b"one")
    place.write("a.npz", b"two")
    place.write("a.json", b"{}")
    assert place.read("a.npz") == b"two"
    assert place.names() == {"a.npz", "a.json"}
    assert place.read_many(["a.npz", "a.json", "b.json"]) == {"a.npz": b"two", "a.json": b"{}"}
    assert place.read_many(["b.json"]) == {}
    place.remove("a.npz")
    place.remove("a.npz")
    assert place.names() == {"a.json"}


def test_outcomes_come_back_from_any_place_and_damaged_ones_do_not(place: Place) -> None:
    store = outcome_store(place.url)
    store.place = place
    outcome = Outcome(track=FlownTrack(flight="f", time_s=np.arange(3.0), position_m=np.eye(3)))
    assert store.save("k", outcome, {"seconds": 1.5})
    assert np.array_equal(store.load("k").track.position_m, np.eye(3))
    assert store.keys() == ({"k"}, set())
    assert store.manifests(["k", "gone"])["k"]["seconds"] == 1.5
    content = bytearray(place.read("k.npz") or b"")
    content[len(content) // 2] ^= 1
    place.write("k.npz", bytes(content))
    assert not store.sound("k")
    assert store.load("k") is None
    assert "damaged" in store.warnings[0]


def test_a_bucket_that_is_not_there_is_told_before_anything_runs(s3: str) -> None:
    with pytest.raises(UsageError, match=r"outcomes cannot be kept in s3://nobodys/season.*bucket"):
        check_place(open_place("s3://nobodys/season"))


def test_a_store_that_is_gone_in_the_middle_is_told_as_such(s3: str, monkeypatch: pytest.MonkeyPatch) -> None:
    where = open_place(f"s3://{BUCKET}/middle")

    def fails(*_: object, **__: object) -> bytes:
        raise ConnectionError("no route")

    monkeypatch.setattr(where._fs, "cat_file", fails)
    with pytest.raises(InputError, match="nothing that was kept is lost"):
        where.read("a")


@pytest.mark.parametrize(
    ("where", "text"),
    [
        ("nosuch://a/b", "outcomes cannot be kept in nosuch://a/b"),
        ("file://elsewhere/tmp/x", "machine 'elsewhere'"),
    ],
)
def test_what_cannot_be_a_place_is_one_message(where: str, text: str) -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(UsageError, match=text):
        open_place(where)


def test_without_fsspec_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name == "fsspec":
            raise ImportError("No module named 'fsspec'")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UsageError, match=r"aerpaw-cmp\[store\]"):
        ObjectStore("s3://bucket/x")


def test_secrets_in_an_address_are_not_shown() -> None:
    assert places._without_secrets("sftp://me:word@host/x") == "sftp://host/x"


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(UsageError, match="cannot be kept"):
        check_place(Folder(tmp_path / "file"))


def test_nothing_of_it_is_loaded_for_a_folder(tmp_path: Path) -> None:
    code = "import sys; from aerpaw_cmp.jobs.place import *; check_place(open_place(sys.argv[1])); print('fsspec' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
