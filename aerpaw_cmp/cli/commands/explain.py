"""``explain``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ..app import Json, LogsRoot, command
from ..shown import number, print_json, records, say, show, table


@command(
    "explain",
    examples=[
        "aerpaw-cmp explain sample_logs/flight.yaml --time 20 --tower LW1",
        "aerpaw-cmp explain flight.yaml --time 2025-06-01T14:00:20Z --tower LW1 --channel USRP2 --json",
    ],
)
def explain(
    flight: Annotated[Path, Argument(help="flight.yaml")],
    time: Annotated[str, Option(help="Seconds after the first sample, or ISO 8601 (time_utc of rss.csv).")],
    tower: Annotated[str, Option(help="Tower of the link.")],
    channel: Annotated[
        str | None, Option(help="Channel of the RSS logs, or 'rank'  [default: first log of the tower]")
    ] = None,
    engine: Annotated[Literal["image", "sionna"] | None, Option(help="Path search  [default: rt.engine]")] = None,
    logs_root: LogsRoot = None,
    as_json: Json = False,
) -> int:
    """List every path of a link at an instant, term by term."""
    from ...jobs.reporting.explain import run_explain

    explanation = run_explain(
        flight, time=time, tower=tower, channel=channel, engine=engine, logs_root=logs_root, progress=say
    )
    if as_json:
        print_json(explanation.as_dict())
    else:
        _print(explanation)
    return 0


def _print(explanation: Any) -> None:
    east, north, up = explanation.position_m
    show(
        f"{explanation.flight}: {explanation.tower} {explanation.channel} at {explanation.time_utc} "
        f"({explanation.time_s:.1f} s)"
    )
    show(f"UAV at {east:.2f} m east, {north:.2f} m north, {up:.2f} m up; {explanation.carrier_hz / 1e9:g} GHz")
    rows = [
        [p.words, f"{p.length_m:.2f}", f"{p.delay_ns:.1f}",
         f"{p.departure_azimuth_deg:.1f} / {p.departure_elevation_deg:.1f}",
         f"{p.arrival_azimuth_deg:.1f} / {p.arrival_elevation_deg:.1f}", f"{p.level_dbm:.2f}", f"{p.phase_deg:.1f}"]
        for p in explanation.paths
    ]  # fmt: skip
    heads = ["path", "m", "ns", "departure az / el deg", "arrival az / el deg", "dBm", "phase deg"]
    if rows:
        table(heads, rows, f"{len(rows)} paths by engine {explanation.engine}")
        deepest_first = sorted(explanation.paths, key=lambda path: -path.depth)
        names = list(dict.fromkeys(name for path in deepest_first for name in path.terms_db))
        power = f"{explanation.transmit_power_dbm:+.2f}"
        terms = [
            [p.words, power, *(number(p.terms_db.get(name), "{:+.2f}") for name in names), f"{p.level_dbm:.2f}"]
            for p in explanation.paths
        ]
        table(["path", "transmitted dBm", *(f"{name} dB" for name in names), "level dBm"], terms, "Terms")
    bounces = [{"path": path.words, **asdict(bounce)} for path in explanation.paths for bounce in path.bounces]
    angle = {"path": "path", "face": "face", "material": "material", "incidence deg": "incidence_deg:.1f"}
    records(bounces, angle | {"|TE| dB": "te_db:.2f", "|TM| dB": "tm_db:.2f"}, "Reflections")
    levels = [number(level, "{:.2f}") for level in (explanation.level_dbm, explanation.power_sum_dbm)]
    show(f"coherent sum {levels[0]} dBm, sum of powers {levels[1]} dBm")
    if explanation.measured_db is not None:
        show(f"measured {number(explanation.measured_db, '{:.2f}')} {explanation.unit}, before any offset")
    for path, reason in explanation.absent:
        show(f"not there: {path}: {reason}")
    for note in explanation.notes:
        show(f"note: {note}")
