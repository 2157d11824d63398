"""Tiles of a map in a Zarr store: written as they come, read back as a map; one that is half written is gone on with.

The store has the variables of ``maps.nc`` (:mod:`aerpaw_cmp.maps.netcdf`), a tile a chunk. ``tile_sha256`` has the
SHA-256 of the chunk files of each tile, entered when they are written: a killed run costs what was in work, and a tile
whose files are missing or were changed is computed again.

A store that is there is data of somebody else until its metadata were compared, as text, with those that this job
writes: Zarr runs the codecs that a store names.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..common.errors import InputError, UsageError, one_line, parsing
from ..common.files import read_input, write_whole
from ..common.geodesy import SiteFrame
from ..common.outputs import explained_os_errors, foreign_entries
from .grid import Grid
from .job import MapResult
from .netcdf import maps_dataset
from .tiles import PLANES, Tiling, over_grid

LEDGER = "tile_sha256"
_PATHS = "tile_paths"
_JOB = "aerpaw_cmp_job"
_ROOT = "zarr.json"
_LARGEST_METADATA = 1 << 20
# Parts of an array's metadata that say how its chunks are decoded, and those that follow from the job.
_DECODING = ("zarr_format", "node_type", "codecs", "chunk_key_encoding", "storage_transformers")
_OF_THE_JOB = ("shape", "data_type", "chunk_grid", "fill_value")
_NAMES = dict(zip(PLANES, ("rss_siso", "rss_mimo", "rss_sd", "rank", "spread", "condition"), strict=True))


class TileStore:
    """A store that tiles of one job are written to.

    Parameters
    ----------
    path : Path
        Folder of the store; made by :meth:`begin`.
    tiling : Tiling
    job : mapping
        All that the values depend on, as JSON takes it; a store of another job is refused.
    force : bool
        Replace the store of another job.

    Attributes
    ----------
    damaged : int
        Tiles that :meth:`begin` found entered, with chunks that are missing or differ.

    Raises
    ------
    UsageError
        If zarr is not installed.
    """

    def __init__(self, path: Path, tiling: Tiling, job: Mapping[str, Any], *, force: bool = False) -> None:
        try:
            import zarr
        except ImportError:
            raise UsageError(
                "zarr is not installed, and a map in tiles is a Zarr store",
                expected="pip install 'aerpaw-cmp[geo]' with Python 3.11 or newer, or a larger --spacing",
            ) from None
        # through JSON and back: as it will be read again, where tuples are lists
        self.path, self.tiling, self._zarr, self._job = path, tiling, zarr, json.loads(json.dumps(job))
        self._force, self.damaged = force, 0

    def begin(self, empty: Mapping[str, MapResult], frame: SiteFrame, about: Mapping[str, str]) -> list[int]:
        """Make the store unless it is there; the tiles that it lacks.

        Parameters
        ----------
        empty : mapping of str to MapResult
            Maps of any tile, by foliage mode: their form.
        frame : SiteFrame
        about : mapping of str to str
            Attributes of the store.

        Returns
        -------
        list of int
            Numbers of the tiles.

        Raises
        ------
        UsageError
            The store is that of another job, or holds files of others.
        InputError
            It is no store of this tool, or a damaged one.
        """
        self._frame, self._about = frame, about
        skeleton = self._skeleton(maps_dataset(empty, frame, about).to_xarray())
        with explained_os_errors(self.path):
            there = os.path.lexists(self.path) and not (self.path.is_dir() and not any(self.path.iterdir()))
            if there and self._is_other_job(skeleton):
                shutil.rmtree(self.path)
                there = False
            try:
                for name, content in skeleton.items():
                    self._repair(self.path / name, content)
            except BaseException:
                if not there:
                    shutil.rmtree(self.path, ignore_errors=True)
                raise
            missing = [number for number in range(len(self.tiling)) if not self._is_kept(number)]
            # r+ makes nothing and removes nothing
            self._group = self._zarr.open_group(self.path, mode="r+", zarr_format=3)
        return missing

    def _skeleton(self, like: Any) -> dict[str, bytes]:
        """The files of a store without tiles, by their names below its folder; its own metadata first."""
        grid, tiles = self.tiling.grid, self.tiling.shape
        # made in memory first: Zarr itself then opens no folder that a stranger may have filled
        files: dict[str, Any] = {}
        memory = self._zarr.storage.MemoryStore(files)
        self._planes = [name for name, variable in like.variables.items() if {"y", "x"} <= {*variable.dims}]
        axes = like.drop_vars(self._planes).assign_coords(
            x=("x", grid.east_m, like.x.attrs), y=("y", grid.north_m, like.y.attrs)
        )
        axes.to_zarr(memory, mode="w", consolidated=False, zarr_format=3)
        group = self._zarr.open_group(memory, mode="r+")
        self._chunk_names = []
        for name in self._planes:
            variable = like[name].variable
            leading = variable.shape[:-2]
            tile = np.minimum(self.tiling.cells, grid.shape).tolist()
            plain = {
                key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in variable.attrs.items()
            }
            group.create_array(
                name, shape=(*leading, *grid.shape), chunks=(*leading, *tile),
                dtype=variable.dtype, fill_value=np.nan if variable.dtype.kind == "f" else 0,
                dimension_names=variable.dims, attributes=plain,
            )  # fmt: skip
            self._chunk_names.append("/".join([name, "c", *"0" * len(leading), "{}", "{}"]))
        group.create_array(
            _PATHS, shape=tiles, chunks=(1, 1), dtype=np.int64, fill_value=0, dimension_names=("tile_y", "tile_x"),
            attributes={"long_name": "paths of each tile"},
        )  # fmt: skip
        self._chunk_names.append(f"{_PATHS}/c/{{}}/{{}}")
        group.create_array(
            LEDGER, shape=(*tiles, 32), chunks=(1, 1, 32), dtype=np.uint8, fill_value=0,
            compressors=None,  # a chunk file is the digest itself: reading it decodes nothing
            dimension_names=("tile_y", "tile_x", "byte"),
            attributes={"long_name": "SHA-256 of the chunks of each tile", "comment": "0: not computed yet"},
        )  # fmt: skip
        group.attrs[_JOB] = json.dumps(self._job)
        content = {name: buffer.to_bytes() for name, buffer in files.items()}
        return {_ROOT: content.pop(_ROOT), **content}

    def _is_other_job(self, skeleton: Mapping[str, bytes]) -> bool:
        """Check whether a store that is there is that of another job and may be replaced; errors as :meth:`begin`."""
        if not self.path.is_dir():
            raise self._not_ours("a file")
        self._refuse_foreign({name.partition("/")[0] for name in skeleton if "/" in name})
        attributes = self._metadata(_ROOT).get("attributes")
        with parsing(self.path):
            job = json.loads(attributes[_JOB]) if isinstance(attributes, dict) and _JOB in attributes else None
        if not isinstance(job, dict):
            raise self._not_ours(f"{_ROOT} names no job of this tool")
        differs = sorted(key for key in {*job, *self._job} if job.get(key) != self._job.get(key))
        parts = _DECODING if differs else (*_DECODING, *_OF_THE_JOB)
        for name, content in skeleton.items():
            if name.endswith(_ROOT) and os.path.lexists(self.path / name):
                ours, theirs = json.loads(content), self._metadata(name)
                if wrong := next((part for part in parts if ours.get(part) != theirs.get(part)), None):
                    raise self._not_ours(f"{wrong} in {name} is {one_line(json.dumps(theirs.get(wrong)))[:80]}")
        if differs and not self._force:
            key = differs[0]
            more = f" and {len(differs) - 1} more" if len(differs) > 1 else ""
            raise UsageError(
                f"the store holds tiles of another job: {key}{more} differs ({job.get(key)}, now {self._job.get(key)})",
                expected="another name after -o, or --force to replace the store",
                path=self.path,
            )
        return bool(differs)

    def _refuse_foreign(self, arrays: set[str]) -> None:
        """UsageError where a store holds what this tool did not write."""
        ours = re.compile(rf"zarr\.json|({'|'.join(map(re.escape, arrays))})/(zarr\.json|c(/\d+)*)")
        names = (entry.relative_to(self.path).as_posix() for entry in self.path.rglob("*"))
        # a disk that was full may have left a folder without its chunk
        below = (name + more for name in names for more in ("", "/c", "/0"))
        if foreign := next(foreign_entries(self.path, filter(ours.fullmatch, below)), None):
            raise UsageError(
                f"the store holds what this tool did not write: {one_line(foreign)}",
                expected="another name after -o: a store is replaced as a whole",
                path=self.path,
            )

    def _metadata(self, name: str) -> dict[str, Any]:
        """Metadata of the store that is there, as JSON and no more."""
        with parsing(self.path / name):
            content = json.loads(read_input(self.path / name, _LARGEST_METADATA, "metadata of a map store"))
        if not isinstance(content, dict):
            raise self._not_ours(f"{name} is no metadata of Zarr 3")
        return content

    def _not_ours(self, reason: str) -> InputError:
        return InputError(
            f"no map store of this tool: {reason}",
            expected="another name after -o, or this store moved away",
            cause="data of another program, another version of zarr, or a damaged file",
            path=self.path,
        )

    def _repair(self, place: Path, content: bytes) -> None:
        """Write a file of the skeleton unless it is there; when the store was written is not looked at."""
        with suppress(OSError):
            before = place.read_bytes()
            if before == content or (place == self.path / _ROOT and _undated(before) == _undated(content)):
                return
        place.parent.mkdir(parents=True, exist_ok=True)
        write_whole(place, content)

    def _chunks(self, number: int) -> Iterator[tuple[str, Path]]:
        """Names and places of the chunk files of one tile; one that holds nothing but missing values has no file."""
        for form in self._chunk_names:
            name = form.format(*divmod(number, self.tiling.shape[1]))
            yield name, self.path / name

    def _digest(self, number: int) -> bytes:
        digest = hashlib.sha256()
        for name, place in self._chunks(number):
            content = place.read_bytes() if place.exists() else b""
            # with its length, so that bytes cannot move from one chunk into the next unseen
            digest.update(f"{name} {len(content)} ".encode() + content)
        return digest.digest()

    def _entry(self, number: int) -> Path:
        row, column = divmod(number, self.tiling.shape[1])
        return self.path / LEDGER / "c" / str(row) / str(column) / "0"

    def _is_kept(self, number: int) -> bool:
        """Check whether a tile is there as it was written; what is left of any other goes, before Zarr decodes it."""
        entry = self._entry(number)
        entered = entry.exists()
        if entered and entry.read_bytes() == self._digest(number):
            return True
        self.damaged += entered
        for place in (entry, *(place for _, place in self._chunks(number))):
            place.unlink(missing_ok=True)
        return False

    def paths(self) -> Any:
        """Paths of each tile (tile rows, tile columns)."""
        return np.asarray(self._group[_PATHS][:])

    def write(self, number: int, maps: Mapping[str, MapResult], paths: int) -> None:
        """Write one tile; :class:`~aerpaw_cmp.common.errors.OutputError` where the disk does not take it.

        Parameters
        ----------
        number : int
        maps : mapping of str to MapResult
            By foliage mode.
        paths : int
            How many there are.
        """
        rows, columns = self.tiling.part(number)
        with explained_os_errors(self.path):
            for name, variable in maps_dataset(maps, self._frame, self._about).variables.items():
                if {"y", "x"} <= {*variable.dims}:
                    self._group[name][..., rows, columns] = variable.values
            self._group[_PATHS][divmod(number, self.tiling.shape[1])] = paths
            entry = self._entry(number)
            entry.parent.mkdir(parents=True, exist_ok=True)
            # last: a tile is there when its entry is, and a run killed before computes it again
            write_whole(entry, self._digest(number))

    def read(self, empty: Mapping[str, MapResult], step: int) -> dict[str, MapResult]:
        """Maps of every ``step``-th position each way, by foliage mode; ``empty`` as for :meth:`begin`."""
        full = self.tiling.grid
        grid = Grid(full.east_m[::step], full.north_m[::step], full.spacing_m * step)
        maps = {}
        for number, (mode, like) in enumerate(empty.items()):
            values = {}
            for field, name in _NAMES.items():
                plane = np.asarray(self._group[name][number, ..., ::step, ::step])
                leading = range(plane.ndim - 2)[::-1]
                kind = np.int8 if field == "rank" else np.float64
                values[field] = plane.transpose(*leading, -2, -1).reshape(*plane.shape[-3::-1], -1).astype(kind)
            maps[mode] = over_grid(like, grid, values)
        return maps


def _undated(metadata: bytes) -> Any:
    """Metadata of a store without the time at which it was made; None of what is none."""
    try:
        content = json.loads(metadata)
        content["attributes"].pop("history", None)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
    return content
