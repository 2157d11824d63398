"""``site import``, ``site show``, ``antenna export``, ``map``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from ...common.errors import UsageError
from ...jobs.options import RunOptions
from ..app import Figures, Flights, Force, antenna_app, command, of_run, output, site_app
from ..shown import answered, page_table, print_files, say, show, table, warn_all


@command(
    "import",
    of=site_app,
    text="Convert map data (GeoJSON, OSM XML, Overpass JSON, KML, KMZ) or a Mitsuba scene to a site.yaml.",
    examples=[
        "aerpaw-cmp site import campus.osm --tower roof=40.0090,-105.2670,25 -o site.yaml",
        "aerpaw-cmp site import munich.xml --origin 48.1372,11.5755 --tower BS=8.5,21,27 -o munich.yaml",
        "aerpaw-cmp site import fields.kml barns.geojson --base my_towers.yaml --untagged building -o site.yaml",
    ],
)
def site_import(
    out: Annotated[Path, output("The site.yaml to write.", "FILE")],
    files: Annotated[list[Path], Argument(help="Map files, or one Mitsuba XML")],
    base: Annotated[
        str | None,
        Option(help="Site whose towers and settings are kept  [default: lake_wheeler for a map without --tower]"),
    ] = None,
    origin: Annotated[
        str | None, Option(help="Scene: latitude,longitude[,ground height] of its origin (0, 0, 0), or 'local'.")
    ] = None,
    tower: Annotated[
        list[str] | None,
        Option(
            help="Antenna; repeatable. Map: NAME=LATITUDE,LONGITUDE,HEIGHT above ground [deg, m]; the first antenna is "
            "the origin. Scene: NAME=EAST,NORTH,HEIGHT [m]."
        ),
    ] = None,
    material: Annotated[
        list[str] | None, Option(help="Scene: id=concrete, for a material without radio properties; repeatable.")
    ] = None,
    turn: Annotated[float, Option(help="Scene: angle of the x axis, counter-clockwise from east [deg].")] = 0.0,
    dem: Annotated[
        Path | None, Option(help="Map: elevation model of the ground (.asc, GeoTIFF) with heights above sea level.")
    ] = None,
    dem_crs: Annotated[str | None, Option(help="Map: coordinate system of an .asc, such as EPSG:4326.")] = None,
    untagged: Annotated[
        Literal["building", "forest", "geofence"] | None, Option(help="Kind assigned to areas without a tag.")
    ] = None,
    trees: Annotated[
        bool, Option("--trees", help="Model woods as single trees at random positions instead of media.")
    ] = False,
    force: Force = False,
) -> None:
    """Import map footprints or a Mitsuba scene as a site."""
    from ...jobs import run, site_scene

    scene = len(files) == 1 and site_scene.is_scene(files[0])
    of_scenes = {"--origin": origin, "--material": material, "--turn": turn}
    of_maps = {"--untagged": untagged, "--trees": trees, "--dem": dem, "--dem-crs": dem_crs}
    for option in (name for name, value in (of_maps if scene else of_scenes).items() if value):
        kinds = ("a Mitsuba scene", "map files") if scene else ("map files", "one Mitsuba XML")
        raise UsageError(f"{option} with {kinds[0]}", expected=f"{kinds[1]}, or no {option}")
    if scene:
        facts = site_scene.SceneOptions(
            origin=origin, base=base, towers=tower or (), materials=material or (), turn_deg=turn
        )
        actions = site_scene.run_scene_import(files[0], out, facts, force=force)
    else:
        actions = run.run_site_import(
            files, out, base=base, towers=tower or (), force=force, dem=dem, dem_crs=dem_crs, untagged=untagged,
            trees=trees, progress=say,
        )  # fmt: skip
    if answered({"file": str(out), "base": base, "actions": actions}):
        return
    for line in actions:
        say(line)
    show(out)


@command(
    "export",
    of=site_app,
    text="Export a site as Mitsuba XML with PLY meshes for sionna.rt.load_scene.",
    examples=["aerpaw-cmp site export lake_wheeler -o scene", "aerpaw-cmp site export site.yaml -o out"],
)
def site_export(
    site: Annotated[str, Argument(help="site.yaml, or the name of a packaged site.")],
    out: Annotated[Path, output("Output folder.")],
    force: Force = False,
) -> None:
    """Export a site for Sionna RT."""
    from ...jobs.site_scene import run_site_export

    files = run_site_export(site, out, force=force).files
    print_files(files if say.as_json else files[:1])


@command(
    "show",
    of=site_app,
    text="Draw the plan of a site, and write a standalone page that shows it in 3-D.",
    examples=["aerpaw-cmp site show", "aerpaw-cmp site show site.yaml -o reports/site"],
    options=of_run("Output folder  [default: reports/site-<site>]", "force"),
)
def site_show(
    options: RunOptions,
    site: Annotated[str, Argument(help="site.yaml, or the name of a packaged site.")] = "lake_wheeler",
) -> None:
    """Show the plan of a site and its 3-D page."""
    from ...jobs import run

    shown = run.run_site_show(site, options)
    if not say.as_json:
        from ...site.learned import learned_lines

        for line in learned_lines(site):
            say(line)
    warn_all(shown.warnings)
    print_files(shown.files)


@command(
    "export",
    of=antenna_app,
    text="Convert a pattern to a custom pattern of Sionna RT (.py) or the two cuts of MSI Planet (.msi).",
    examples=[
        "aerpaw-cmp antenna export SA3300.txt -o sa3300.py",
        "aerpaw-cmp antenna export azimuth.csv --elevation elevation.csv --carrier 3.4e9 -o horn.msi",
        "aerpaw-cmp antenna export rad_pat.mat --variable SA3300 -o sa3300.py",
    ],
)
def antenna_export(
    file: Annotated[Path, Argument(help="Pattern: AERPAW text or .mat, MSI, a sphere .csv, an azimuth cut .csv")],
    out: Annotated[Path, output("File to write: .py or .msi.", "FILE")],
    elevation: Annotated[Path | None, Option(metavar="CSV", help="Elevation cut, if FILE is an azimuth cut.")] = None,
    variable: Annotated[str | None, Option(help="Name of the gain grid in a .mat file.")] = None,
    carrier: Annotated[
        float | None, Option(min=1.0, help="Frequency [Hz]: selects one of several in FILE, and is written to .msi.")
    ] = None,
    force: Force = False,
) -> None:
    """Convert an antenna pattern for another program."""
    from ...jobs.site_scene import run_antenna_export

    outcome = run_antenna_export(file, out, elevation=elevation, variable=variable, carrier_hz=carrier, force=force)
    print_files(outcome.files)


@command(
    "map",
    examples=[
        "aerpaw-cmp map --quick",
        "aerpaw-cmp map site.yaml --spacing 15 --dry-run",
        "aerpaw-cmp map site.yaml -o reports/map --spacing 20 --rank-altitude 30 --rank-altitude 70",
        "aerpaw-cmp map lake_wheeler --foliage none --no-study --json",
        "aerpaw-cmp map site.yaml --tx-power-dbm 30 --bandwidth-mhz 20 --noise-figure-db 7 --threshold-dbm -90",
        "aerpaw-cmp map lake_wheeler --with flight1.yaml --with flight2.yaml",
    ],
    options=of_run("Output folder  [default: reports/map-<site>]", "logs_root", "workers", "scheduler", "dry", "force"),
)
def map_(
    options: RunOptions,
    site: Annotated[str, Argument(help="site.yaml, or the name of a packaged site.")] = "lake_wheeler",
    quick: Annotated[bool, Option("--quick", help="A coarse map in seconds: 120 m, three heights.")] = False,
    foliage: Annotated[
        list[str] | None, Option(help="none, attenuating, opaque or all; repeatable  [default: all]")
    ] = None,
    spacing: Annotated[float | None, Option(help="Distance between positions [m]  [default: 30]")] = None,
    rss_altitude: Annotated[
        list[float] | None, Option(help="Height of RSS maps [m]; repeatable  [default: 30, 70, 110]")
    ] = None,
    rank_altitude: Annotated[
        list[float] | None, Option(help="Height of rank maps [m]; repeatable  [default: 3 and 30 to 110 by 10]")
    ] = None,
    k: Annotated[
        list[float] | None, Option("-k", "--k", help="Singular-value ratio K; repeatable  [default: 10, 100, 1000]")
    ] = None,
    carrier_ghz: Annotated[float | None, Option(help="Carrier frequency [GHz]  [default: 3.4]")] = None,
    max_depth: Annotated[int | None, Option(min=0, max=3, help="Largest number of reflections  [default: 2]")] = None,
    tx_power_dbm: Annotated[float | None, Option(help="Transmit power of a tower [dBm]  [default: 40]")] = None,
    bandwidth_mhz: Annotated[
        float | None, Option(help="Receiver bandwidth [MHz], from which the noise floor follows.")
    ] = None,
    noise_figure_db: Annotated[float | None, Option(help="Noise figure of the receiver [dB]  [default: 0]")] = None,
    threshold_dbm: Annotated[
        float | None, Option(help="Lowest level that counts as coverage [dBm]  [default: any path]")
    ] = None,
    threshold_snr_db: Annotated[float | None, Option(help="Lowest SNR that counts as coverage [dB].")] = None,
    flights: Flights = None,
    study: Annotated[
        bool | None,
        Option("--study/--no-study", help="Study correlation and interpolation  [default: without power, threshold]"),
    ] = None,
    tile_m: Annotated[
        float | None,
        Option(help="Side of tiles written to a Zarr store [m]  [default: 128 positions, from 1e6 receivers on]"),
    ] = None,
    figures: Figures = "none",
) -> None:
    """Map coverage and rank of a site."""
    from ...jobs import run
    from ...jobs.coverage_map import map_settings
    from ...report.maps import coverage_table

    chosen: dict[str, Any] = {
        "foliage": None if not foliage or "all" in foliage else tuple(dict.fromkeys(foliage)),
        "spacing_m": spacing,
        "rss_altitudes_m": tuple(sorted(set(rss_altitude))) if rss_altitude else None,
        "rank_altitudes_m": tuple(sorted(set(rank_altitude))) if rank_altitude else None,
        "ks": tuple(sorted(set(k))) if k else None,
        "carrier_hz": None if carrier_ghz is None else carrier_ghz * 1e9,
        "max_depth": max_depth,
        "study": study,
        "tile_m": tile_m,
        "tx_power_dbm": tx_power_dbm,
        "bandwidth_mhz": bandwidth_mhz,
        "noise_figure_db": noise_figure_db,
        "threshold_dbm": threshold_dbm,
        "threshold_snr_db": threshold_snr_db,
    }
    settings = map_settings(site, chosen, quick=quick)
    if not say.as_json:
        show(settings.budget.sentence())
    outcome = run.run_map(site, settings, options, flights=flights or (), figures=figures)
    warn_all(outcome.metrics["warnings"])
    if answered(outcome.metrics):
        return
    if settings.budget.level_dbm is not None:
        page_table(coverage_table([m for m in outcome.metrics["coverage"] if m["foliage"] == settings.shown]))
    rows = [[p["where"], p["what"], p["paper"], p["ours"]] for p in outcome.metrics["paper"]]
    if rows:
        table(["where", "what", "paper", "here"], rows, "Values of the paper and of this run")
    for path in outcome.files:
        if path.parent == outcome.folder:
            show(path)
