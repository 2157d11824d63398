"""Find the real logs in AERPAW_CMP_FIELD_DATA. If it is not set, tests marked ``field`` are skipped with a message."""

import os
from pathlib import Path
from typing import Any

REAL = Path(os.environ.get("AERPAW_CMP_FIELD_DATA") or "/nowhere")


def dataset12(name: str) -> dict[str, Any]:
    """Return the columns of a flight of dataset 12. Its authors' x and y are not the same axes in all files."""
    import numpy as np
    from scipy.io import loadmat

    columns = loadmat(REAL / "dataset12" / f"{name}.mat")
    data = {k: np.ravel(v).astype(float) for k, v in columns.items() if k[0] == "m" or k == "timestamp_power"}
    longitude, latitude = ("mX", "mY") if data["mX"].mean() < 0 else ("mY", "mX")
    return data | {"longitude": data[longitude], "latitude": data[latitude]}
