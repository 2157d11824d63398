"""The jobs of the command line, each as named stages."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from ..common.cf import library
from ..common.errors import UsageError, noting_interrupts, typed
from ..common.files import cache_folder
from ..common.outputs import OutputFile, OutputFolder, is_sealed, sealed
from ..common.stages import PlannedStage
from ..common.text import counted
from ..common.yamlfile import input_files
from .options import AGAINST_DISTANCE_M, DEFAULT, JobOutcome, RunOptions

_KIND_OF = {"rss_db": "rss", "ri_raw": "rank"}


def mapping(pairs: list[str]) -> dict[str, Any]:
    """Return the reader options of ``--map COLUMN=quantity``: the columns, and the kind of record.

    ``rank`` means a rank indicator that counts from one.

    Raises
    ------
    UsageError
        If a pair is malformed, or if two pairs name the same quantity.
    """
    columns: dict[str, str] = {}
    for pair in pairs:
        column, mark, quantity = pair.rpartition("=")
        quantity = {"rank": "ri_raw"}.get(quantity.strip(), quantity.strip())
        if not mark or not column or not quantity:
            raise UsageError(f"--map {pair!r}", expected="COLUMN=quantity, e.g. --map 'Power (dBm)=rss_db'")
        if quantity in columns:
            raise UsageError(
                f"--map names two columns for {quantity!r}",
                expected="one column per quantity",
                cause="several levels: list the table in flight.yaml once per level, with 'columns:'",
            )
        columns[quantity] = column.strip()
    kind = next((kind for quantity, kind in _KIND_OF.items() if quantity in columns), "telemetry")
    return {"columns": columns, "kind": kind, **({"ri_base": "one"} if kind == "rank" else {})}


def run_ingest(
    paths: list[Path],
    *,
    out: Path | None = None,
    draft: Path | None = None,
    site: str | None = None,
    reader: str | None = None,
    force: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Read logs and return their summary. Also write a flight file (``out``) and a draft of flight.yaml (``draft``).

    Parameters
    ----------
    paths : list of Path
        Log files and folders.
    out : Path, optional
        The flight file (HDF5) to write.
    draft : Path, optional
        The flight.yaml to write.
    site : str, optional
        Site of the draft: a packaged site or a site.yaml. Default: lake_wheeler.
    reader : str, optional
        Reader for all files. Default: each file is recognised.
    force : bool
        Also replace files that this tool did not write. Inputs are never replaced.
    options
        Fields of :class:`aerpaw_cmp.logs.readers.ReadOptions`.

    Returns
    -------
    dict
        The result of :func:`aerpaw_cmp.logs.ingest.summary`. A draft adds ``draft`` (remarks to check) and ``drafts``
        (paths); ``out`` adds the names of its ``flights``.
    """
    from ..logs.flight_file import fill, is_flight_file
    from ..logs.ingest import ingest, summary
    from ..logs.readers import ReadOptions
    from ..logs.text import zone

    if name := options.get("timezone"):
        zone(name, needed_by="--timezone")  # report a misspelt zone as an error of the command, not of the first log
    if out is not None and draft is not None and os.path.realpath(out) == os.path.realpath(draft):
        raise UsageError("-o and --draft name the same file", expected="two names", path=draft)
    inputs = [*paths, *([] if site is None else [Path(site)])]
    with ExitStack() as outputs:

        def output(path: Path, own: Callable[[Path], bool] = is_sealed) -> OutputFile:
            return outputs.enter_context(OutputFile(path, own=own, inputs=inputs, force=force))

        # report a wrong output name before the logs are read
        target = None if out is None else output(out, is_flight_file)
        drafted = None if draft is None else output(draft)
        files = ingest(paths, options=ReadOptions(**options), reader=reader)
        account = summary(files)
        if draft is not None and drafted is not None:
            account |= _write_drafts(files, draft, drafted, output, site, options)
        if target is not None:
            from ..flight.drafting.draft import flights_by_name

            target.write(partial(fill, files=files))
            account["flights"] = list(flights_by_name(files))
    return account


def _write_drafts(
    files: list[Any], draft: Path, first: OutputFile, output: Callable[[Path], OutputFile], site: str | None,
    options: dict[str, Any],
) -> dict[str, Any]:  # fmt: skip
    """Write a flight file for each flight in the logs, and return remarks and paths."""
    from ..flight.drafting.draft import SITE, DraftOptions, drafts

    home = first.target.parent
    if site is not None and Path(site).is_file():
        site = os.path.relpath(Path(site).resolve(), home.resolve())
    mapping = {key: options[key] for key in ("columns", "kind", "unit", "ri_base") if options.get(key)}
    clock = {key: options.get(key) for key in ("timezone", "time_origin")}
    try:
        flights = drafts(files, home, DraftOptions(mapping=mapping, site=site or SITE, **clock))
    except UsageError as error:
        error.others = files  # their account helps to see what is missing
        raise
    # write drafts of further flights to the same folder, because paths in a draft are relative to it
    numbers = range(2, len(flights) + 1)
    places = [draft, *(draft.with_name(f"{draft.stem}_{number}{draft.suffix}") for number in numbers)]
    remarks = []
    for place, file, flight in zip(places, [first, *map(output, places[1:])], flights, strict=True):
        file.write(sealed(flight.text))
        remarks += [remark if place is draft else f"{place.name}: {remark}" for remark in flight.remarks]
    return {"draft": remarks, "drafts": [str(place) for place in places]}


def run_simulate(flight: Path, options: RunOptions = DEFAULT) -> JobOutcome:
    """Write a folder with the logs that ``flight.plan`` describes, the flight file and the true values.

    Parameters
    ----------
    flight : Path
        flight.yaml with ``flight.plan``.
    options : RunOptions
        ``out`` is ``simulated/NAME`` by default, with the name of the flight.

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError, OutputError
        The same as in :meth:`aerpaw_cmp.flight.simulate.FlightSimulator.run`.
    """
    from ..flight.data import choose_site
    from ..flight.gains import load_with_learned
    from ..flight.simulate import FlightSimulator
    from .tasks import inputs_of_flight

    settings = load_with_learned(flight)
    site = choose_site(settings.site, flight.parent)
    simulator = FlightSimulator(settings, site, flight.parent)
    # the logs of the flight file are outputs here, not inputs
    inputs = inputs_of_flight(settings.model_copy(update={"logs": []}), flight)
    folder = options.out or Path("simulated") / settings.flight.name
    stages = options.stages("simulate", inputs, folder)
    files = simulator.run(folder, inputs=inputs, force=options.force, stages=stages)
    cautions = tuple(f"{text}." for text in site.cautions())
    return JobOutcome(folder=folder, files=tuple(files), warnings=cautions)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """Options of one report on the command line.

    Parameters
    ----------
    audit : str, optional
        Number of audited links ("full", "none" or a number), instead of ``rt.audit_links``.
    recommend : Path, optional
        Path of the flight file to write with the settings of the recommended model.
    learned : path, optional
        calibrated.yaml whose antennas, ground and receiver replace those of the flight file.
    against : sequence of path
        Predictions of this flight to score: output folders of ``predict``, or files of other programs.
    against_distance_m : float
        Largest distance between a sample and its predicted position, for other programs.
    figures : {"none", "svg", "png", "pdf", "all"}
        Format of figures as files: none, one format, or all formats.
    kmz : bool
        Also write ``samples.kmz``.
    netcdf : bool
        Also write ``rss.nc`` and ``rank.nc``.
    """

    audit: str | None = None
    recommend: Path | None = None
    learned: Path | str | None = None
    against: Sequence[Path] = ()
    against_distance_m: float = AGAINST_DISTANCE_M
    figures: str = "none"
    kmz: bool = False
    netcdf: bool = False


def run_report(flight: Path, chosen: ReportOptions = ReportOptions(), options: RunOptions = DEFAULT) -> JobOutcome:
    """Replay a flight, calibrate and compare it, and write the report.

    Parameters
    ----------
    flight : Path
    chosen : ReportOptions
    options : RunOptions
        ``out`` is ``reports/<flight>`` by default.

    Returns
    -------
    JobOutcome
    """
    from ..flight.data import load_data
    from ..flight.gains import foliage_notes
    from ..flight.replay import replay_flight
    from ..flight.settings import load_flight
    from ..report.flight import metrics as metrics_of
    from ..report.flight import write_report
    from ..report.flight_data import pose_paths, report_data
    from ..report.page import json_text, write_file
    from .flight_run import check_recommended, recommended_text, report_stages, run_flight
    from .referee import judge, possible, read_foreign
    from .tasks import other_inputs

    _check_options(flight, chosen, options)
    settings, inputs, folder = _report_inputs(flight, chosen, options)
    stages = options.stages("report", inputs, folder)
    learned = None if chosen.learned is None else Path(chosen.learned)
    with ExitStack() as outputs:
        output = outputs.enter_context(OutputFolder(folder, job="report", inputs=inputs, force=options.force))
        target = None
        if chosen.recommend is not None:
            file = OutputFile(chosen.recommend, own=is_sealed, inputs=inputs, force=options.force)
            target = outputs.enter_context(file)
        with stages("read"):
            data = load_data(settings, flight.parent, options.logs_root)
            read = partial(read_foreign, data=data, near_m=chosen.against_distance_m)
            given, unread = possible(read, chosen.against)
        if chosen.recommend is not None:
            check_recommended(data)
        stages.checked(lambda: report_stages(data, chosen.figures))
        replays = replay_flight(data, stages)
        flight_run = run_flight(data, stages, replays=replays, fresh=chosen.audit is not None, ladder=True)
        carriers = {replayed.link.carrier_hz for replayed in replays.all}
        record = report_data(
            data,
            flight_run.result,
            notes=foliage_notes(data.site.wooded, settings.rt, carriers),
            other_inputs=other_inputs(settings, flight, options.logs_root, learned),
            paths=pose_paths(data, replays),
        )
        with stages("score predictions") if given else nullcontext():
            cards, unscored = possible(partial(judge, data=data, result=flight_run.result), given)
        if cards:
            scores = {"referee": cards, "referee_refused": (refused := [*unread, *unscored])}
            record = replace(
                record, extra_metrics={**record.extra_metrics, **scores}, warnings=(*refused, *record.warnings)
            )
        if target is not None:
            text, sentence = recommended_text(load_flight(flight), flight_run.ladder, flight)
            target.write(sealed(text))
            record = replace(record, extra_metrics={**record.extra_metrics, "recommended": sentence})
        with output.filling() as place:
            _, record = write_report(
                record, place, drawn=chosen.figures, kmz=chosen.kmz, netcdf=chosen.netcdf, stages=stages
            )
            if cards:
                write_file(place / "card.json", json_text(cards, indent=1))
    metrics = metrics_of(record)
    return JobOutcome(folder=folder, metrics=metrics, failed_checks=_failed_checks(metrics))


def _check_options(flight: Path, chosen: ReportOptions, options: RunOptions) -> None:
    """Raise UsageError for options that exclude each other, and for a missing library."""
    from ..report.page import FIGURES

    if chosen.netcdf:
        library("netCDF4")
    if chosen.figures not in FIGURES:
        raise UsageError(f"--figures {chosen.figures}", expected=f"one of {', '.join(FIGURES)}")
    beside, home = (chosen.recommend or flight).parent, flight.parent
    if options.logs_root is None and os.path.realpath(beside) != os.path.realpath(home):
        # paths in a flight file are relative to its folder
        raise UsageError(
            f"--recommend in another folder than {flight}",
            expected="a name in the folder of the flight file, whose paths are relative to it; or --logs-root",
            path=chosen.recommend,
        )


def _report_inputs(flight: Path, chosen: ReportOptions, options: RunOptions) -> tuple[Any, list[Path], Path]:
    """Return the settings, changed by the command line, the files that they name, and the folder of results."""
    from ..flight.gains import load_with_learned
    from .tasks import inputs_of_flight

    learned = None if chosen.learned is None else Path(chosen.learned)
    settings = _with_audit(load_with_learned(flight, learned), chosen.audit)
    inputs = [
        *inputs_of_flight(settings, flight, options.logs_root),
        *([] if learned is None else [learned]),
        *chosen.against,
    ]
    return settings, inputs, options.out or Path("reports") / settings.flight.name


def _with_audit(settings: Any, audit: str | None) -> Any:
    """Return the settings with the number of audited links of the command line."""
    if audit is None:
        return settings
    # represent "full" by a number that is larger than the number of links of any flight
    numbers = {"full": 10**9, "none": 0}
    if audit not in numbers and not audit.isdecimal():
        raise UsageError(f"--audit {audit!r}", expected="a number of links, 'full' or 'none'")
    links = numbers[audit] if audit in numbers else int(audit)
    return settings.model_copy(update={"rt": settings.rt.model_copy(update={"audit_links": links})})


def _failed_checks(metrics: dict[str, Any]) -> tuple[str, ...]:
    """Return sentences about the requested checks that failed."""
    from ..report.page import links_of

    failed = []
    for (tower, channel), m in links_of(metrics["rss"]).items():
        link = f"{tower} {channel}"
        if m["n"] == 0:
            failed.append(f"{link}: no sample could be compared")
        elif m["at_search_edge"]:
            failed.append(f"{link}: the best offset is at the end of its search range")
    audit = (metrics.get("rt") or {}).get("audit") or {}
    if (metrics.get("rt") or {}).get("not_audited"):
        failed.append("audit: the replay was not audited; a warning states the reason")
    if audit.get("missing_paths"):
        failed.append(
            f"audit: the engine misses {counted(audit['missing_paths'], 'path')} that {audit['reference']} finds"
        )
    failed += [f"audit of the field: {text}" for text in (audit.get("field") or {}).get("failures", ())]
    return tuple(failed)


def run_site_import(
    files: list[Path],
    out: Path,
    *,
    base: str | None = None,
    towers: Sequence[str] = (),
    force: bool = False,
    **options: Any,
) -> list[str]:
    """Write a site.yaml from map files, and return a description of each step.

    Parameters
    ----------
    files : list of Path
        GeoJSON, OSM XML, Overpass JSON, KML or KMZ.
    out : Path
        The site.yaml to write.
    base : str, optional
        Site whose towers and settings are kept. Default: Lake Wheeler if no tower is named.
    towers : sequence of str
        ``NAME=LATITUDE,LONGITUDE,HEIGHT`` of antennas. The first antenna is the origin if there is no base.
    force : bool
        Replace a file that this tool did not write.
    **options
        Further options of :func:`~aerpaw_cmp.site.footprints.import_site`, such as ``dem``.

    Returns
    -------
    list of str
        One line per action.
    """
    from ..site.footprints import import_site, site_yaml
    from ..site.learned import copy_learned

    inputs = [*files, *(Path(name) for name in (base, options.get("dem")) if name is not None)]
    with OutputFile(out, own=is_sealed, inputs=inputs, force=force) as output:
        model, actions = import_site(files, base=base, towers=towers, **options)
        text = site_yaml(model, header=["made by 'aerpaw-cmp site import' from map data", *actions])
        output.write(sealed(text))
    # do not copy learned antennas if towers are named, because the antennas belong to the towers of the base site
    return [*actions, *([] if towers else copy_learned(base or "lake_wheeler", out))]


def run_site_show(site: str, options: RunOptions = DEFAULT) -> JobOutcome:
    """Write a plan view of a site and a page that shows it in 3-D.

    Parameters
    ----------
    site : str
        site.yaml, or the name of a packaged site.
    options : RunOptions
        ``out`` is ``reports/site-SITE`` by default.

    Returns
    -------
    JobOutcome
    """
    from ..report.site import write_site_view
    from ..site.siteyaml import inputs_of_site, load_site

    out = options.out or Path("reports") / f"site-{Path(site).stem}"
    with OutputFolder(out, job="site show", inputs=inputs_of_site(site), force=options.force) as output:
        place = load_site(site)
        with output.filling() as folder:
            written = write_site_view(place, folder)
        cautions = tuple(f"{text}." for text in place.cautions())
        return JobOutcome(folder=out, files=output.placed(written), warnings=cautions)


def run_map(
    site: str, settings: Any, options: RunOptions = DEFAULT, *, flights: Sequence[Path] = (), figures: str = "none"
) -> JobOutcome:
    """Write coverage and rank maps of a site, their correlation and interpolation, as a page and as files.

    Parameters
    ----------
    site : str
        site.yaml, or the name of a packaged site.
    settings : MapSettings
    options : RunOptions
    flights : sequence of Path
        Flight files from which the corrections of levels and ranks are learned (:mod:`.predict`).
    figures : {"none", "png", "svg", "pdf", "all"}
        Format of figures as files: none, one format, or all formats.

    Returns
    -------
    JobOutcome
    """
    from ..maps.grid import Grid
    from ..report.maps import maps_metrics, write_maps
    from ..site.siteyaml import inputs_of_site, load_site
    from . import coverage_map as mapping
    from .paper_table import paper_rows
    from .sources import files_of, named_flights
    from .workers import open_workers

    # read the flights before the site, so that a misspelt flight is reported at once
    known = named_flights(flights)
    place, progress = load_site(site), options.progress
    if flights and settings.tile_cells(Grid.over_area(place.area_m, settings.spacing_m)):
        raise UsageError("flights and a map in tiles", expected="fewer receivers, or a map without --with")
    inputs = [*inputs_of_site(site), *files_of(known, options.logs_root)]
    folder = options.out or Path("reports") / f"map-{Path(site).stem}"
    stages = options.stages("map", inputs, folder)
    with OutputFolder(folder, job="map", inputs=inputs, force=options.force) as output:
        mapping.check_study(place, settings)
        stages.checked(lambda: mapping.map_stages(place, settings, [f.load(options.logs_root) for f in known]))
        file = [Path(site).absolute()] if Path(site).is_file() else []
        with open_workers(options.workers, options.scheduler, paths=file, progress=progress) as crew:
            outcome = mapping.make_maps(
                place, settings, stages, workers=crew, name=str(file[0] if file else site),
                out=folder,
            )  # fmt: skip
        if flights:
            from .predict import corrected_maps

            heights = settings.rss_altitudes_m, settings.rank_altitudes_m
            outcome.corrected = corrected_maps(site, settings.spacing_m, heights, known, options.logs_root, stages)
        if outcome.settings.study:
            mapping.study_maps(outcome, stages)
        with output.filling() as part:
            with stages("export"):
                files = mapping.export_maps(outcome, part, progress)
            progress("page")
            record = mapping.maps_record(
                outcome, name=Path(site).stem, stages_s=stages.seconds, paper=paper_rows(outcome)
            )
            written = write_maps(record, part, figures)
        if outcome.store is not None:
            outcome.store.remove()
        return JobOutcome(folder=folder, metrics=maps_metrics(record), files=output.placed([*written, *files]))


def run_campaign(
    path: Path, options: RunOptions = DEFAULT, *, keep: Path | None = None, fresh: bool = False
) -> JobOutcome:
    """Replay and compare many flights under many settings, and write a page with held-out numbers.

    Parameters
    ----------
    path : Path
        campaign.yaml.
    options : RunOptions
    keep : Path, optional
        Folder for the outcomes of single tasks, instead of the user's cache. A rerun computes only missing outcomes.
    fresh : bool
        Neither read nor store outcomes.

    Returns
    -------
    JobOutcome

    Raises
    ------
    UsageError
        If campaign.yaml is wrong. A flight that cannot be read is a row of the result instead.
    """
    from ..report.campaign import campaign_metrics, edge_warnings, write_campaign
    from .campaign import find_reports, load_campaign, soundings, with_season
    from .campaign import run as run_all
    from .tasks import inputs_of_flights

    if fresh and keep is not None:
        raise UsageError("--fresh and --keep", expected="one of them: --fresh neither reads nor writes a folder")
    campaign = load_campaign(path)
    sounded = [(options.logs_root or path.parent) / name for name in campaign.soundings]
    flights = inputs_of_flights((path.parent / name for name in campaign.flights), options.logs_root)
    inputs = [path, *sounded, *flights]
    nodes = soundings(sounded, campaign.timezone) if sounded else ()
    folder = options.out or Path("reports") / campaign.campaign
    stages = options.stages("campaign", inputs, folder)
    # an address such as s3:// is not a folder. As a path, it has a single slash after the colon.
    if keep is not None and ":/" in str(keep):
        raise UsageError(f"--keep {keep}", expected="a folder")
    store = None if fresh else keep or cache_folder("outcomes")
    note = f"finished tasks are stored in {store}; the same command computes the rest" if store else "nothing is stored"
    with OutputFolder(folder, job="campaign", inputs=inputs, force=options.force) as output, noting_interrupts(note):
        data = run_all(campaign, path.parent, options, keep=store, stages=stages)
        data = with_season(data, find_reports(data.flights, folder), nodes)
        with stages("report"), output.filling() as place:
            finished = replace(data, stages_s=dict(stages.seconds))
            write_campaign(finished, place)
            _write_tracebacks(data.failures, place)
    failed = [f"{f.flight} ({f.setting}): {f.message}" for f in data.failures]
    failed += edge_warnings(data)
    metrics = campaign_metrics(replace(data, stages_s=dict(stages.seconds)))
    return JobOutcome(folder=folder, metrics=metrics, failed_checks=tuple(failed))


def _write_tracebacks(failures: Sequence[Any], folder: Path) -> None:
    """Write one file per failed task in ``failures/``: its message and its traceback."""
    from ..report.texts import safe_name

    for failure in failures:
        if failure.traceback:
            target = folder / "failures" / f"{safe_name(failure.flight)}__{safe_name(failure.setting)}.txt"
            target.parent.mkdir(exist_ok=True)
            target.write_text(
                f"{failure.flight}, {failure.setting}: {failure.message}\n\n{failure.traceback}", encoding="utf-8"
            )


def calibrate_command(path: Path, further: Sequence[Path], into_site: str | None) -> str:
    """Return the command that repeats a calibration, with paths as the user typed them."""
    words: list[str | Path] = [path, *further, *([] if into_site is None else ["--into-site", into_site])]
    return f"aerpaw-cmp calibrate {' '.join(map(typed, words))}"


def run_calibrate(
    path: Path,
    options: RunOptions = DEFAULT,
    *,
    further: Sequence[Path] = (),
    into_site: str | None = None,
    score: Sequence[Path] = (),
) -> JobOutcome:
    """Learn antennas from flights and write ``calibrated.yaml`` and a folder of its name with antennas and page.

    Parameters
    ----------
    path : Path
        calibration.yaml, or a flight file.
    options : RunOptions
        ``out`` is the file to write. The folder is next to it.
    further : sequence of Path
        Further flight files to learn from.
    into_site : str, optional
        Site (site.yaml or packaged) in which the results are stored, with one entry per campaign.
    score : sequence of Path
        Flight files that are scored with all learned antennas. Flights with training logs are reported but not scored.

    Returns
    -------
    JobOutcome
        The settings file is the first of its ``files``.
    """
    from ..site.learned import damage_remark, folder_of, store_entry
    from ..site.siteyaml import inputs_of_site, site_model
    from .calibrate import calibrate, load_calibration, read_flights
    from .calibrate_rank import fit_rank, samples_by_tower
    from .calibration_files import Calibrated, site_entries, write_files
    from .tasks import inputs_of_flights

    settings, damaged = load_calibration(path, further), list[str]()
    if into_site is not None:
        site_model(into_site)  # report a misspelt site before the fit, so that nothing is stored under its name
        damaged = damage_remark(folder_of(into_site), settings.by_campaign())  # refuse an index of another version
    target = options.out or Path(f"{settings.calibration}.calibrated.yaml")
    if target.suffix.lower() not in (".yaml", ".yml"):
        raise UsageError("the output is not a YAML file", expected="-o NAME.yaml", path=target)
    inputs = input_files(settings, path, options.logs_root)
    inputs += inputs_of_flights([*(path.parent / name for name in settings.flights), *score], options.logs_root)
    inputs += [] if into_site is None else inputs_of_site(into_site)
    stages, folder = options.stages("calibrate", inputs, target), target.with_suffix("")
    with (
        OutputFile(target, own=is_sealed, inputs=inputs, force=options.force) as file,
        OutputFolder(folder, job="calibrate", inputs=inputs, force=options.force) as output,
    ):
        with stages("read"):
            flights, remarks, campaigns = read_flights(settings, path.parent, options.logs_root)
            remarks += damaged
            reports = samples_by_tower(flights) if settings.rank else {}
        ranked, calibration = None, None
        if not settings.rank or any(data.rss for data in flights):
            calibration = calibrate(
                settings, flights, path.parent, options.logs_root, campaigns=campaigns, stages=stages, score=score
            )
        stages.checked(lambda: [PlannedStage("rank", counted(len(reports), "receiver"))])
        if settings.rank:
            with stages("rank"):
                ranked = fit_rank(reports)
        calibrated = Calibrated(
            settings=settings, flights=tuple(flights), remarks=tuple(remarks), calibration=calibration, ranked=ranked,
            command=calibrate_command(path, further, into_site), campaigns=campaigns,
        )  # fmt: skip
        with output.filling() as place:
            metrics, text = write_files(calibrated, place, folder.name, stages.seconds)
        file.write(sealed(text))
    if into_site is not None:
        entries = site_entries(calibrated)
        metrics["into_site"] = [str(f) for name, made in entries.items() for f in store_entry(into_site, name, *made)]
    return JobOutcome(folder=folder, metrics=metrics, files=(target,))
