"""An I/Q burst of AERPAW's ``get_IQ.py``: ``results_<Hz>_<samples per s>_<YYYY_mm_dd_HH_MM_SS_mmm>.mat``.

``IQ`` is (channels, samples) complex. The level of a channel is the mean power of its samples over the burst, 10
log10, in dB re full scale. The time of the burst is the local time in the file name. A flight is a folder of thousands
of bursts, which ``ingest`` reads as one log.
"""

from __future__ import annotations

import re

import numpy as np

from aerpaw_cmp.logs.matfile import MAGIC, names_of, read_arrays
from aerpaw_cmp.readers import Attribute, InputError, Reader, ReadOptions, ReadResult, built, split

_NAME = re.compile(r"(\d{6,12})(?:\.0)?_(\d{4,10})(?:\.0)?_(\d{4})_(\d\d)_(\d\d)_(\d\d)_(\d\d)_(\d\d)_?(\d{3,6})?")


def sniff(head: bytes) -> bool:
    """Check whether the first variables of a file are samples and device times."""
    return head.startswith(MAGIC) and "IQ" in names_of(head)


def read(data: bytes, options: ReadOptions) -> ReadResult:
    """Return one level per channel, ``USRP1`` and so on.

    Raises
    ------
    InputError
        If there are no samples, or the file name does not contain the time of the burst.
    UsageError
        If no time zone is given.
    """
    samples = read_arrays(data, {"IQ"}).get("IQ")
    if samples is None or not samples.size:
        raise InputError("the burst has no samples", expected="a variable IQ, channels by samples")
    named = _NAME.search(options.file_name)
    if named is None:
        raise InputError(
            "the name of the burst does not contain its time",
            expected="results_<Hz>_<samples per s>_<YYYY_mm_dd_HH_MM_SS_mmm>.mat",
            cause="a renamed file",
        )
    year, month, day, hour, minute, second, part = named.groups()[2:]
    text = f"{year}-{month}-{day} {hour}:{minute}:{second}.{part or '0'}".encode()
    # the burst is the only line of its account
    rows = built(split(b"\n"), np.zeros(1, dtype=np.int64), {"time": np.array([text])}, options, reader="iq_burst")
    if not len(rows):
        return rows.result([])
    with np.errstate(all="ignore"):  # damaged samples may have any value
        power = np.mean(np.abs(np.atleast_2d(samples)) ** 2, axis=1)
    streams = []
    about: dict[str, Attribute | None] = {"frequency_hz": options.frequency_hz or float(named[1])}
    about["unit"] = options.unit or "dB re full scale"
    for channel, mean_square in enumerate(power.tolist(), start=1):
        level, flag = rows.level(np.array([10 * np.log10(mean_square) if 0 < mean_square < np.inf else np.nan]))
        name = f"USRP{channel}"
        streams.append(rows.stream("rss", name, {"rss_db": level}, flag=flag, channel=name, about=about))
    return rows.result(streams)


READER = Reader(
    name="iq_burst", title="I/Q burst of get_IQ.py (.mat); a folder of bursts is one log", kinds=("rss",),
    sample="results_3320000000_2000000_2025_01_01_12_00_07_250.mat", sniff=sniff, read=read, pieces=True,
)  # fmt: skip
