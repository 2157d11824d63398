"""Settings of a flight file that cannot act: a report warns of each, because a value that does nothing misleads.

A value that equals its default is not reported. Names that no flight could have are refused
(:func:`aerpaw_cmp.flight.data.check_names`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from functools import reduce

import numpy as np
import pandas as pd
from pydantic import BaseModel

from ..logs.ingest import IngestedFile
from .settings import FlightFile, LogSettings

# A log with relative times starts at its origin; a longer distance shows that its times are absolute.
_NEAR_ORIGIN = pd.Timedelta(days=2)


def idle_log_keys(log: LogSettings, file: IngestedFile) -> list[str]:
    """Return a warning per reason why keys of a line of ``logs:`` have no effect on its log."""
    streams = file.result.streams
    kinds = {stream.kind for stream in streams}
    keys: dict[str, list[str]] = {}
    if "rss" not in kinds:
        keys["it has no levels"] = ["channel", "frequency_hz", "unit", "floor_db", "cells"]
    elif not any(stream.attributes.get("pci") in log.cells or stream.name in log.cells for stream in streams):
        keys["it has none of these cells"] = ["cells"]
    if not kinds & {"rss", "rank"}:
        keys["it has neither levels nor ranks"] = ["node"]
    if file.result.reader != "generic_csv":
        keys[f"the reader {file.result.reader} knows its columns"] = ["columns", "kind"]
    bases = {str(stream.attributes["ri_base"]) for stream in streams if "ri_base" in stream.attributes}
    if log.ri_base is not None and log.ri_base not in bases:
        keys[f"the log counts from {' and '.join(bases)}" if bases else "it has no ranks"] = ["ri_base"]
    if log.time_origin is not None and not _starts_near(log.time_origin, file):
        keys["its times are absolute"] = ["time_origin"]
    return [
        f"{log.path}: {', '.join(stated)} {'has' if len(stated) == 1 else 'have'} no effect: {why}"
        for why, names in keys.items() if (stated := [name for name in names if _differs(log, name)])
    ]  # fmt: skip


def _starts_near(origin: str, file: IngestedFile) -> bool:
    # an origin that cannot be read is near nothing
    zero = pd.to_datetime(origin, errors="coerce", utc=True).tz_localize(None)
    times = [s.frame["time"].min() for s in file.result.streams if len(s.frame) and "time" in s.frame]
    return not times or bool(np.min([abs(time - zero) for time in times]) < _NEAR_ORIGIN)


def idle_settings(settings: FlightFile, kinds: Collection[str]) -> list[str]:
    """Return a warning per reason why settings have no effect.

    Parameters
    ----------
    settings : FlightFile
    kinds : collection of {"rss", "rank"}
        What the logs measured.
    """
    texts = []
    for why, keys in _reasons(settings, kinds):
        stated = [key for key in keys.split() if _differs(settings, key)]
        if stated:
            texts.append(f"{', '.join(stated)} {'has' if len(stated) == 1 else 'have'} no effect: {why}")
    return texts


def _reasons(settings: FlightFile, kinds: Collection[str]) -> Iterator[tuple[str, str]]:
    """Yield reasons, and the dotted keys that cannot act because of each."""
    rt, lag = settings.rt, settings.rss.lag
    if rt.foliage != "attenuating":
        foliage = "foliage_model leaves advanced.gamma_db_per_m advanced.maximum_loss_db"
        yield f"rt.foliage is {rt.foliage}", " ".join(f"rt.{key}" for key in foliage.split())
    if rt.max_depth == 0:
        yield "rt.max_depth is 0, so nothing is reflected", "rt.reflection_loss_db rt.ground_roughness_m"
    if rt.engine == "image" and rt.audit_links == 0:
        yield "rt.engine is image and rt.audit_links is 0, so no rays are shot", "rt.advanced.samples"
    if lag not in ("estimate", "apply"):
        yield f"rss.lag is {lag}, so no clock is estimated", "rss.advanced.lag_window_s"
    if "rss" not in kinds:
        yield "no log has levels", "rss.span_db rss.lag rss.field rss.minimum_height_m"
    if "rank" not in kinds:
        yield "no log has ranks", "rank.receiver rank.minimum_height_m"


def _differs(model: BaseModel, key: str) -> bool:
    """Check whether the value of a dotted key is not its default."""
    *above, name = key.split(".")
    part = reduce(getattr, above, model)
    return bool(getattr(part, name) != type(part).model_fields[name].get_default(call_default_factory=True))
