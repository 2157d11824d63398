"""Files that a site is made of: the site.yaml and what it names. No output may replace one; a report names each."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from importlib import resources
from pathlib import Path

from ..common.errors import AerpawCmpError
from ..common.inputs import named_files
from .siteyaml import SiteModel, packaged_name, site_model


def inputs_of_site(site: str | Path, folder: Path = Path()) -> list[Path]:
    """The site file, as it is named in a folder, and what it names; none where it is wrong, which its reader says."""
    with suppress(AerpawCmpError, OSError):
        return [place for _, _, place in site_files(str(site), folder)]
    return []


def site_files(name: str, folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Name, role and place of the site file, as it is named in a folder, and of what it names."""
    path = folder / name
    if not path.is_file():
        _site_model(name, 0, 0)
        packaged = f"{packaged_name(name)}.yaml"
        with resources.as_file(resources.files(__package__) / "data" / packaged) as file:
            yield f"aerpaw_cmp/site/data/{packaged}", "site file (packaged)", file
        return
    yield name, "site file", path
    status = path.stat()
    model = _site_model(path, status.st_size, status.st_mtime_ns)
    for key, text, place in named_files(model.model_dump(), [path.parent]):
        yield text, f"site: {key}", place


# by size and time, too: a site that is edited between two tasks is read again
@lru_cache(maxsize=16)
def _site_model(site: str | Path, _size: int, _mtime_ns: int) -> SiteModel:
    """A site file as checked; a campaign asks for the same one with every task."""
    return site_model(site)
