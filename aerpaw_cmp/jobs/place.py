"""Where outcomes are kept: a folder, or an object store by URL; an entry appears whole or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import uuid
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from ..common.errors import InputError, UsageError
from ..common.files import atomic_path

_OBJECT_STORES = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "oci", "oss", "memory"}
"""Protocols that put an object whole or not at all; elsewhere it is written beside and renamed."""


class Place(Protocol):
    """Named pieces of bytes."""

    url: str
    """As a message may show it, and as another process opens it."""

    def read(self, name: str) -> bytes | None:
        """Content, or None where there is none."""

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:
        """Contents of those that are there."""

    def write(self, name: str, content: bytes) -> None:
        """Write whole or not at all; OSError where it cannot be."""

    def names(self) -> set[str]:
        """Of everything that is there."""

    def remove(self, name: str) -> None:
        """Remove what may be there."""


class Folder:
    """A folder on a disk that this machine sees; it is made when the first entry is written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = str(folder)

    def read(self, name: str) -> bytes | None:  # noqa: D102
        try:
            return (self.folder / name).read_bytes()
        except OSError:
            return None

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:  # noqa: D102
        return {name: content for name in names if (content := self.read(name)) is not None}

    def write(self, name: str, content: bytes) -> None:  # noqa: D102
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(self.folder / name) as part:
            part.write_bytes(content)

    def names(self) -> set[str]:  # noqa: D102
        try:
            with os.scandir(self.folder) as entries:
                return {entry.name for entry in entries}
        except OSError:
            return set()

    def remove(self, name: str) -> None:  # noqa: D102
        with contextlib.suppress(OSError):
            (self.folder / name).unlink(missing_ok=True)


class ObjectStore:
    """A folder behind a URL, by fsspec: ``s3://bucket/season`` and what else it knows.

    Keys and addresses come from the store's own surroundings (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``,
    ``~/.aws/config``, ``FSSPEC_S3_...``): campaign.yaml holds no secrets.
    """

    def __init__(self, url: str) -> None:
        self.url = _without_secrets(url)
        protocol = url.split("://", 1)[0]
        try:
            import fsspec

            self._fs, self._root = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except ImportError as error:
            raise UsageError(
                f"{self.url} needs a package that is not installed ({error})",
                expected="pip install 'aerpaw-cmp[store]' (fsspec and s3fs); other stores: fsspec's package for them",
            ) from None
        except Exception as error:  # unknown protocols, wrong addresses: each package has words of its own
            raise _unusable(self.url, error) from None
        self._puts = protocol in _OBJECT_STORES

    def _path(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}"

    def read(self, name: str) -> bytes | None:  # noqa: D102
        try:
            return bytes(self._fs.cat_file(self._path(name)))
        except FileNotFoundError:
            return None
        except Exception as error:
            raise _unreachable(self.url, error) from error

    def read_many(self, names: Iterable[str]) -> dict[str, bytes]:  # noqa: D102
        by_path = {self._path(name): name for name in names}
        if not by_path:
            return {}
        try:
            contents = self._fs.cat(list(by_path), on_error="omit")
        except FileNotFoundError:
            return {}
        except Exception as error:
            raise _unreachable(self.url, error) from error
        if not isinstance(contents, Mapping):  # one path gives its content alone
            return {next(iter(by_path.values())): bytes(contents)}
        return {by_path[path]: bytes(content) for path, content in contents.items() if path in by_path}

    def write(self, name: str, content: bytes) -> None:  # noqa: D102
        path = self._path(name)
        try:
            if self._puts:
                self._fs.pipe_file(path, content)
                return
            self._fs.makedirs(self._root, exist_ok=True)
            part = f"{path}.{uuid.uuid4().hex}.part"
            self._fs.pipe_file(part, content)
            self._fs.mv(part, path)
        except OSError:
            raise
        except Exception as error:
            raise OSError(f"{type(error).__name__}: {error}") from error

    def names(self) -> set[str]:  # noqa: D102
        try:
            self._fs.invalidate_cache()
            return {str(path).rstrip("/").rsplit("/", 1)[-1] for path in self._fs.ls(self._root, detail=False)}
        except FileNotFoundError:
            return set()
        except Exception as error:
            raise _unreachable(self.url, error) from error

    def remove(self, name: str) -> None:  # noqa: D102
        with contextlib.suppress(Exception):
            self._fs.rm_file(self._path(name))


def open_place(where: str | Path) -> Place:
    """A folder for a path or ``file://``, an object store for any other URL.

    Raises
    ------
    UsageError
        A protocol that is not known, or a package that is missing.
    """
    text = str(where)
    if isinstance(where, Path) or "://" not in text:
        return Folder(Path(where).expanduser())
    protocol = text.split("://", 1)[0].lower()
    if protocol in ("file", "local"):
        parts = urlsplit(text)
        if parts.netloc not in ("", "localhost"):
            raise UsageError(f"{text}: a folder on the machine {parts.netloc!r}", expected="file:///FOLDER")
        return Folder(Path(unquote(parts.path)))
    return _opened(text)


@lru_cache(maxsize=4)
def _opened(url: str) -> ObjectStore:
    return ObjectStore(url)


def check_place(place: Place) -> None:
    """Write, read and remove a probe, so that what is wrong is told before anything runs.

    Raises
    ------
    UsageError
        With the store's own words.
    """
    name, content = f"probe-{uuid.uuid4().hex}", hashlib.sha256(os.urandom(8)).digest()
    try:
        place.write(name, content)
        read_back = place.read(name)
    except Exception as error:
        raise _unusable(place.url, error) from None
    place.remove(name)
    if read_back != content:
        raise UsageError(f"outcomes cannot be kept in {place.url}: a probe did not come back as it was written")


def _unusable(url: str, error: BaseException) -> UsageError:
    return UsageError(
        f"outcomes cannot be kept in {url}: {_words(error)}",
        expected="a folder, or a URL such as s3://BUCKET/NAME of a bucket that exists and may be written",
        cause="a bucket or folder that is not there, keys that are not set, or an address that is not reached",
    )


def _unreachable(url: str, error: BaseException) -> InputError:
    return InputError(
        f"outcomes cannot be read from {url}: {_words(error)}",
        cause="the store is not reached any more; nothing that was kept is lost, run the same command again",
    )


def _words(error: BaseException) -> str:
    return _without_secrets(f"{error}".strip() or type(error).__name__)


def _without_secrets(text: str) -> str:
    return re.sub(r"://[^/@\s]*@", "://", text)
