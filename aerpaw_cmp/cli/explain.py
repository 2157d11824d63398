"""``explain``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Optional

import typer

from .app import Json, LogsRoot, command
from .shown import number, print_json, say, table


@command(
    "explain",
    examples=[
        "aerpaw-cmp explain sample_logs/flight.yaml --time 20 --tower LW1",
        "aerpaw-cmp explain flight.yaml --time 2025-06-01T14:00:20Z --tower LW1 --channel USRP2 --json",
        "aerpaw-cmp explain flight.yaml --time 20 --tower LW1 --engine both",
    ],
)
def explain(
    flight: Annotated[Path, typer.Argument(help="flight.yaml")],
    time: Annotated[str, typer.Option(help="Seconds after the first sample, or ISO 8601 (time_utc of rss.csv).")],
    tower: Annotated[str, typer.Option(help="Whose link.")],
    channel: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Of the RSS logs, or 'rank'; default: the tower's first log."),
    ] = None,
    engine: Annotated[
        Optional[Literal["image", "sionna", "both"]],  # noqa: UP045
        typer.Option(help="Whose paths, in place of rt.engine; both: also what either lacks, and why."),
    ] = None,
    logs_root: LogsRoot = None,
    as_json: Json = False,
) -> int:
    """List every path of a link at an instant, term by term."""
    from ..jobs.explain import run_explain

    found = run_explain(
        flight, time=time, tower=tower, channel=channel, engine=engine, logs_root=logs_root, progress=say
    )
    if as_json:
        print_json(found.as_dict())
    else:
        _print(found)
    return 0


def _print(found: Any) -> None:
    east, north, up = found.position_m
    print(f"{found.flight}: {found.tower} {found.channel} at {found.time_utc} ({found.time_s:.1f} s)")
    print(f"UAV at {east:.2f} m east, {north:.2f} m north, {up:.2f} m up; {found.carrier_hz / 1e9:g} GHz")
    rows = []
    for path in found.paths:
        rows.append(
            [
                path.words,
                f"{path.length_m:.2f}",
                f"{path.delay_ns:.1f}",
                f"{path.departure_azimuth_deg:.1f} / {path.departure_elevation_deg:.1f}",
                f"{path.arrival_azimuth_deg:.1f} / {path.arrival_elevation_deg:.1f}",
                f"{path.level_dbm:.2f}",
                f"{path.phase_deg:.1f}",
            ]
        )
    heads = ["path", "m", "ns", "departure az / el deg", "arrival az / el deg", "dBm", "phase deg"]
    if rows:
        table(heads, rows, f"{len(rows)} paths by engine {found.engine}")
        deepest_first = sorted(found.paths, key=lambda path: -path.depth)
        names = list(dict.fromkeys(name for path in deepest_first for name in path.terms_db))
        power = f"{found.transmit_power_dbm:+.2f}"
        terms = [
            [p.words, power, *(number(p.terms_db.get(name), "{:+.2f}") for name in names), f"{p.level_dbm:.2f}"]
            for p in found.paths
        ]
        table(["path", "transmitted dBm", *(f"{name} dB" for name in names), "level dBm"], terms, "Terms")
    bounces = [
        [path.words, b.face, b.material, f"{b.incidence_deg:.1f}", f"{b.te_db:.2f}", f"{b.tm_db:.2f}"]
        for path in found.paths
        for b in path.bounces
    ]
    if bounces:
        table(["path", "face", "material", "incidence deg", "|TE| dB", "|TM| dB"], bounces, "Reflections")
    levels = [number(level, "{:.2f}") for level in (found.level_dbm, found.power_sum_dbm)]
    print(f"coherent sum {levels[0]} dBm, sum of powers {levels[1]} dBm")
    if (other := found.other_interactions) is not None:
        power, level = number(other.power_dbm, "{:.2f}"), number(other.level_dbm, "{:.2f}")
        kinds = ", ".join(f"{count} {kind}" for kind, count in other.kinds.items()) or "none found"
        print(
            f"{' and '.join(other.interactions)} by Sionna: {kinds}; {power} dBm together, level with them {level} dBm"
        )
    if found.measured_db is not None:
        print(f"measured {number(found.measured_db, '{:.2f}')} {found.unit}, before any offset")
    for path, reason in found.absent:
        print(f"not there: {path}: {reason}")
    if found.differences is not None:
        if not found.differences:
            print("both engines have the same paths")
        for one in found.differences:
            other = "sionna" if one.found_by == "image" else "image"
            level = number(one.level_dbm, "{:.2f}")
            print(f"{one.found_by} has and {other} has not: {one.path} ({level} dBm): {one.reason}")
    for note in found.notes:
        print(f"note: {note}")
