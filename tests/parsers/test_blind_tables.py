"""Tables whose right reading was written down before any reader saw them: how many are read wrongly without a warning?

``pytest -s`` prints the count of each batch and the tables that are not read right. Each entry of a batch also states the
verdict at its ``first_run``, before the readers were changed.
"""

import re
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

from aerpaw_cmp.common.errors import InputError, UsageError
from aerpaw_cmp.jobs.run import mapping
from aerpaw_cmp.logs.ingest import ReadOptions, ingest

BATCHES = sorted((Path(__file__).parent / "blind").glob("batch_*.yaml"))
NAMES = {"dB re full scale": "dBFS", "sea": "sea level", "takeoff": "take-off"}


def valid(streams, column):
    """Return the streams that have valid rows: attributes, number of these rows, the first and the last."""
    frames = [(s, s.frame[s.frame["flag"].isin(["", "no_fix"])].dropna(subset=column)) for s in streams]
    return [(s.attributes, len(f), f.sort_values("time", kind="stable").iloc[[0, -1]]) for s, f in frames if len(f)]


def far(wanted, values, most):
    return not np.abs(np.subtract(wanted, values.to_numpy(float))).max() <= most  # true for NaN


def late(wanted, rows, most=0.02):
    """Check the times of two rows. After an unknown start ("+3.5") only the duration counts."""
    relative = wanted[0].startswith("+")
    times = [float(t) if relative else np.datetime64(t.rstrip("Z"), "ns").astype(np.int64) / 1e9 for t in wanted]
    differences = np.subtract(times, rows["time"].to_numpy("datetime64[ns]").astype(np.int64) / 1e9)
    return ["clock|time|day"] * bool(np.abs(differences - relative * differences[0]).max() > most)


def faults_of(expect, streams, part=False):
    """Return a pattern of the warning that each difference deserves; with ``part``, series may be missing."""
    if not expect:
        return [""] * any(stream.kind != "kpi" for stream in streams)
    faults = []
    for kind, column, doubt in (("rss", "rss_db", "level|power|unit|series"), ("rank", "rank", "rank")):
        left, may = valid([s for s in streams if s.kind == kind], column), expect.get("may", [])
        for one in expect.get(kind, []) + may:
            (first, low), (last, high) = one["first"], one["last"]
            same = [s for s in left if s[1] in np.ravel(one["rows"]) and not far([low, high], s[2][column], 0.06)]
            faults += [doubt] * (not same and not part and one not in may)
            for attributes, _, rows in same[:1]:
                unit = NAMES.get(attributes.get("unit"), attributes.get("unit"))
                faults += [doubt] * (unit != one.get("unit", unit) and one not in may and not part)
                faults += late([first, last], rows, 0.02 + one.get("slack_s", 0.0))
                left = [s for s in left if s is not same[0]]
        faults += [doubt] * bool(left)
    if (track := expect.get("track")) and not part:
        tracks = [s for s in streams if s.kind == "telemetry"]
        attributes, count, rows = next(iter(valid(tracks, "latitude_deg")), ({}, 0, None))
        if rows is None or far(track["first"], rows[["latitude_deg", "longitude_deg"]].iloc[0], 2e-6):
            return [*faults, "position"]
        height, zero = rows["altitude_m"].iloc[:1] + attributes.get("height_taken_off_m", 0.0), track.get("height")
        zeros = (None, attributes.get("height_datum", "take-off"))
        other = "height_m" in track and (far([track["height_m"]], height, 0.1) or NAMES.get(zero, zero) not in zeros)
        faults += ["position"] * (count != track.get("rows", count)) + ["altitude|height"] * other
        faults += late([track["start"], track["end"]], rows)
    return faults


def tried(expect, path, part=False, reader=None, **options):
    """Return the verdict on one way to read a table, with the differences and the words of the reader."""
    try:
        result = ingest([path], options=ReadOptions(**options), reader=reader)[0].result
    except (InputError, UsageError) as error:
        return "refused", str(error)
    assert result.lines == result.accepted + len(result.rejected) + result.blank
    faults = faults_of(expect, result.streams, part)
    named = all(any(re.search(fault, warning) for warning in result.warnings) for fault in faults)
    return "right" if not faults else "warned" if named else "wrong", f"{faults} {[*result.warnings]}"


def verdict(entry, folder):
    """Read a table as it is, then with the answer to the question of the reader, then as the reader proposes."""
    path, expect, newline = folder / entry["file"], entry.get("expect"), "\r\n" if "newline" in entry else "\n"
    path.write_text(entry["text"], encoding=entry.get("encoding", "utf-8"), newline=newline)
    found, words = tried(expect, path, **entry.get("options", {}))
    if found == "refused" and "ask" in entry:
        found, words = tried(expect, path, **entry["remedy"]) if "remedy" in entry else ("right", words)
    pairs = [f"{column}={quantity}" for column, quantity in re.findall(r"--map '(.*?)'=(\w+)", words)]
    if found != "wrong" and pairs and expect:
        unit, answers = re.search(r"--unit (\w+)", words), entry.get("remedy", entry.get("options", {}))
        options = {**mapping(pairs), "unit": unit and unit[1], "timezone": "UTC"} | answers
        after, more = tried(expect, path, part=True, reader="generic_csv", **options)
        return "wrong" if after == "wrong" else found, f"{words} THEN {after} {more}"
    return found, words


@pytest.mark.parametrize("batch", BATCHES, ids=lambda path: path.stem)
def test_at_most_three_percent_are_silently_wrong(batch, tmp_path):
    entries = yaml.load(batch.read_text(encoding="utf-8"), yaml.CSafeLoader)
    verdicts = {entry["name"]: verdict(entry, tmp_path) for entry in entries}
    sys.stdout.writelines(f"{name} {found} {words}\n" for name, (found, words) in verdicts.items() if found != "right")
    count, first = Counter(found for found, _ in verdicts.values()), Counter(entry["first_run"] for entry in entries)
    sys.stdout.write(f"{batch.stem}: {len(entries)} tables, {dict(count)}; at the first run {dict(first)}\n")
    assert len(verdicts) == len(entries) >= 40
    assert count["wrong"] <= 0.03 * len(entries)
