"""Each job as named stages on one page."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import UsageError

if TYPE_CHECKING:
    from .flight import FlightData

Progress = Callable[[str], None]


def _silent(_text: str) -> None:
    """No progress."""


@dataclass(slots=True)
class Stages:
    """Seconds of each named stage, in order."""

    progress: Progress = _silent
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one stage."""
        self.progress(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def run_ingest(paths: list[Path], *, out: Path | None = None, reader: str | None = None, **options: Any) -> dict[str, Any]:
    """Read logs, write the flight file when ``out`` is given, and give the summary of DESIGN section 3."""
    from .ingest import ingest, summary
    from .readers import ReadOptions
    from .store import write_flight

    files = ingest(paths, options=ReadOptions(**options), reader=reader)
    if out is not None:
        write_flight(out, files)
    return summary(files)


def run_simulate(flight: Path, *, out: Path | None = None, progress: Progress = _silent) -> list[Path]:
    """Write the logs that ``flight.plan`` describes, beside the flight file or below ``out``."""
    from .config import load_flight
    from .flight import choose_site
    from .simulate import FlightSimulator

    settings = load_flight(flight)
    site = choose_site(settings.site, flight.parent)
    return FlightSimulator(settings, site, flight.parent).run(out or flight.parent, progress=progress)


@dataclass(frozen=True, slots=True)
class ReportOutcome:
    """What ``aerpaw-cmp report`` made: the folder, metrics.json as a dict, and stated checks that failed."""

    folder: Path
    metrics: dict[str, Any]
    failed_checks: tuple[str, ...]


def run_report(
    flight: Path,
    *,
    out: Path | None = None,
    logs_root: Path | None = None,
    engine: str | None = None,
    audit: str | None = None,
    progress: Progress = _silent,
) -> ReportOutcome:
    """Replay a flight, calibrate, compare, report.

    Raises
    ------
    UsageError, InputError
        With what was found, expected, and the likely cause.
    """
    from .config import load_flight
    from .flight import gather, read_logs

    stages = Stages(progress)
    with stages("read"):
        settings = _overridden(load_flight(flight), engine, audit)
        files = read_logs(settings, flight.parent, logs_root)
        data = gather(settings, flight.parent, files)
    from .comparison import audit_replays, compare_rank_series, compare_rss_series
    from .replaying import estimate_clocks, replay_rank, replay_rss

    with stages("clocks"):
        clocks = estimate_clocks(data, progress)
    with stages("replay"):
        rss_replays = replay_rss(data, progress, clocks)
        rank_replays = replay_rank(data, progress)
    with stages("compare"):
        rss = [compare_rss_series(data, series, replayed) for series, replayed in zip(data.rss, rss_replays, strict=True)]
        rank = [
            compare_rank_series(data, series, replayed) for series, replayed in zip(data.rank, rank_replays, strict=True)
        ]
    with stages("audit"):
        engine_record = audit_replays(data, [*rss_replays, *rank_replays], progress)
    with stages("report"):
        from .report.export import metrics as metrics_of
        from .report.export import write_report

        record = _report_data(data, rss, rank, engine_record, stages)
        folder = out or Path("reports") / settings.flight.name
        write_report(record, folder)
        metrics = metrics_of(record)
    return ReportOutcome(folder, metrics, _failed_checks(metrics))


def _overridden(settings: Any, engine: str | None, audit: str | None) -> Any:
    """The settings with what the command line says instead."""
    change: dict[str, Any] = {}
    if engine is not None:
        if engine not in ("image", "sionna"):
            raise UsageError(f"--engine {engine!r}", expected="image or sionna")
        change["engine"] = engine
    if audit is not None:
        numbers = {"full": 10**9, "none": 0}
        if audit not in numbers and not audit.isdigit():
            raise UsageError(f"--audit {audit!r}", expected="a number of links, 'full' or 'none'")
        change["audit_links"] = numbers.get(audit, int(audit) if audit.isdigit() else 0)
    return settings.model_copy(update={"rt": settings.rt.model_copy(update=change)})


def _report_data(data: FlightData, rss: list[Any], rank: list[Any], engine: Any, stages: Stages) -> Any:
    from .comparison import inputs_of, track_of, versions, waypoints_of
    from .report.data import ReportData

    settings = data.settings
    site_note = "Buildings and forests of this site are illustrative: they were not surveyed."
    warnings = list(data.warnings)
    if data.site.illustrative and (data.site.buildings or settings.rt.foliage != "none"):
        warnings.append(site_note)
    warnings += [w for result in (*rss, *rank) for w in result.warnings]
    return ReportData(
        title=settings.report.title or settings.flight.title or settings.flight.name,
        flight=settings.flight.name,
        site=data.site,
        generated=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        versions=versions(),
        inputs=inputs_of(data),
        track=track_of(data),
        waypoints=waypoints_of(data),
        rss=tuple(r.panel for r in rss),
        rank=tuple(r.panel for r in rank),
        engine=engine,
        synthetic=settings.flight.synthetic,
        warnings=tuple(dict.fromkeys(warnings)),
        notes=(*settings.flight.notes, *data.site.notes),
        settings=settings.model_dump(mode="json"),
        stages_s=dict(stages.seconds),
    )


def _failed_checks(metrics: dict[str, Any]) -> tuple[str, ...]:
    """Checks that the report states and that did not hold."""
    failed = []
    for tower, channels in metrics["rss"].items():
        for channel, m in channels.items():
            if m["n"] == 0:
                failed.append(f"{tower} {channel}: no sample could be compared")
            elif m["at_search_edge"]:
                failed.append(f"{tower} {channel}: the best offset lies at the edge of the searched span")
    audit = (metrics.get("rt") or {}).get("audit") or {}
    if audit.get("missing_paths"):
        failed.append(f"audit: the engine misses {audit['missing_paths']} paths that {audit['reference']} finds")
    return tuple(failed)
