"""The real logs that AERPAW_CMP_FIELD_DATA names; tests marked ``field`` are skipped, saying so, where it names none."""

import os
from pathlib import Path
from typing import Any

REAL = Path(os.environ.get("AERPAW_CMP_FIELD_DATA") or "/nowhere")


def dataset12(name: str) -> dict[str, Any]:
    """Columns of a flight of data set 12; its authors' x and y are not the same axis in all their files."""
    import numpy as np
    from scipy.io import loadmat

    columns = loadmat(REAL / "dataset12" / f"{name}.mat")
    data = {k: np.ravel(v).astype(float) for k, v in columns.items() if k[0] == "m" or k == "timestamp_power"}
    longitude, latitude = ("mX", "mY") if data["mX"].mean() < 0 else ("mY", "mX")
    return data | {"longitude": data[longitude], "latitude": data[latitude]}
