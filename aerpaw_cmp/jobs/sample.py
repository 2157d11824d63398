"""The sample flight as files of one's own: ``aerpaw-cmp sample -o DIR``."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..common.errors import UsageError
from ..common.outputs import OutputFolder

# Where a wheel holds the samples.
PACKAGED = Path(__file__).parents[1] / "sample_logs"

# Where a checkout of the project holds them.
CHECKOUT = Path(__file__).parents[2] / "sample_logs"


def sample_folder() -> Path:
    """The folder of the sample flight.

    Raises
    ------
    UsageError
        If neither the installed package nor a checkout around it has one.
    """
    for folder in (PACKAGED, CHECKOUT):
        if (folder / "flight.yaml").is_file():
            return folder
    raise UsageError(
        "the sample flight is not here",
        expected=f"{PACKAGED} or {CHECKOUT}",
        cause="a package that was built without its samples",
    )


def write_sample(out: Path, *, force: bool = False) -> Path:
    """Copy flight.yaml and the logs of the sample flight into a folder; gives the path of its flight.yaml."""
    source = sample_folder()
    files = [path for path in sorted(source.rglob("*")) if path.is_file() and path.name != "SHA256SUMS"]
    with OutputFolder(out, job="sample", inputs=files, force=force) as output, output.filling() as folder:
        for path in files:
            place = folder / path.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
    return out / "flight.yaml"
