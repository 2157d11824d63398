"""The ``sample`` job: copy the sample flight into a folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..common.errors import UsageError
from ..common.outputs import OutputFolder

# Folder of the samples in an installed package.
PACKAGED = Path(__file__).parents[1] / "sample_logs"

# Folder of the samples in a checkout of the project.
CHECKOUT = Path(__file__).parents[2] / "sample_logs"


def sample_folder() -> Path:
    """Return the folder of the sample flight.

    Raises
    ------
    UsageError
        If neither the installed package nor a checkout has the sample flight.
    """
    for folder in (PACKAGED, CHECKOUT):
        if (folder / "flight.yaml").is_file():
            return folder
    raise UsageError(
        "the sample flight is missing",
        expected=f"{PACKAGED} or {CHECKOUT}",
        cause="the package was built without its samples",
    )


def write_sample(out: Path, *, force: bool = False) -> Path:
    """Copy flight.yaml and the logs of the sample flight into a folder, and return the path of flight.yaml."""
    source = sample_folder()
    files = [path for path in sorted(source.rglob("*")) if path.is_file() and path.name != "SHA256SUMS"]
    with OutputFolder(out, job="sample", inputs=files, force=force) as output, output.filling() as folder:
        for path in files:
            place = folder / path.relative_to(source)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)
    return out / "flight.yaml"
