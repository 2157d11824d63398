"""Diffraction against reflections in one process: CPU seconds, ratio, paths; and a town of triangles.

1. 5 towers x ``--poses`` poses x 12 buildings, 4 x 4 elements, depth 2: replays without and with edges in turn, on one
   thread, ``--pairs`` times; the ratio is that of what diffraction adds to what the reflections take;
2. with ``--town``: munich with 200 receivers, depth 2, single diffraction (Sionna RT must be installed: its scene);
3. with ``--flights``: flight files with the site's buildings (each of tests/field where none is named), without and
   with edges: RMSE of levels, kappa and agreement of ranks at K = 10, and whether diffraction pays, by the interval of
   the paired difference (95 %);
4. with ``--sionna``: Sionna RT's ``edge_diffraction`` behind a metal screen less the exact half-plane (the values that
   the tests hold), by the polarisation of the elements and the angle of shadow.

Run: python benchmarks/diffraction.py [--poses 10000] [--pairs 3] [--town] [--sionna] [--json]
     python benchmarks/diffraction.py --flights [FILE...] --logs-root DIR
"""

import argparse
import csv
import json
import os
import time
from pathlib import Path

import numpy as np
from scenes import ends, shipped  # type: ignore[import-not-found]

from aerpaw_cmp.common.geodesy import SiteFrame
from aerpaw_cmp.compare.statistics.intervals import paired_difference
from aerpaw_cmp.jobs.bench import random_scene
from aerpaw_cmp.jobs.notebook import open_flight
from aerpaw_cmp.propagation.arrays import Link, Poses, single_element
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import Replay, replay
from aerpaw_cmp.site.mesh_scenes.mitsuba import read_scene
from aerpaw_cmp.site.site import Site, Tower

VERDICTS = {"better": "it pays", "worse": "it costs"} | dict.fromkeys(
    ("not significant", "no interval"), "it does not pay"
)
FIELD = Path(__file__).parents[1] / "tests" / "field"


def timed(case: tuple[Site, Link, Poses], diffraction: str) -> tuple[Replay, float]:
    start = time.process_time()
    replayed = replay(*case, Search(diffraction=diffraction), run=Run(threads=1))
    return replayed, time.process_time() - start


def boxes(poses: int, pairs: int) -> dict[str, float]:
    """What edges add to a replay of boxes."""
    case = random_scene(poses, towers=5)
    for mode in ("none", "edges"):
        timed(case, mode)
    rows = [(timed(case, "none"), timed(case, "edges")) for _ in range(pairs)]
    plain, bent = (float(np.median([row[k][1] for row in rows])) for k in (0, 1))
    return {
        "links": poses * 5,
        "reflections_cpu_s": plain,
        "diffraction_cpu_s": bent - plain,
        "ratio": float(np.median([(b - a) / a for (_, a), (_, b) in rows])),
        "paths": len(rows[0][0][0].paths),
        "edge_paths": len(rows[0][1][0].edge_paths or ()),
    }


def town(receivers: int = 200) -> dict[str, float]:
    """Munich with single diffraction."""
    (source,), targets = ends("munich", receivers)
    towers = {"T": Tower("T", 48.1, 11.6, float(source[0]), float(source[1]), antenna_height_m=float(source[2]))}
    site = Site("munich", SiteFrame(48.1, 11.6), towers, scene=read_scene(shipped("munich")))
    link = Link(3.5e9, {"T": single_element()}, single_element())
    poses = Poses(targets, np.broadcast_to(np.eye(3), (receivers, 3, 3)).copy())
    few = Poses(targets[:2], poses.rotation[:2])
    row: dict[str, float] = {"receivers": receivers}
    for mode in ("none", "edges"):
        timed((site, link, few), mode)  # compiles, and merges the triangles
        replayed, seconds = timed((site, link, poses), mode)
        street = targets[:, 2] < 2.0
        row |= {f"{mode}_cpu_s": seconds, f"{mode}_silent_at_1.5_m": int((~replayed.has_path[street, 0]).sum())}
    return row | {"edge_paths": len(replayed.edge_paths or ()), "street_receivers": int(street.sum())}


def flight(path: str, logs_root: str | None) -> list[str]:
    """A sentence for each channel and each tower's rank: its error without and with edges, and the difference."""
    results = []
    for mode in ("none", "edges"):
        changed = {"site.without_buildings": False, "rt.diffraction": mode, "rt.audit_links": 0}
        results.append(open_flight(path, logs_root=logs_root, overrides=changed).compare())
    without, edges = (scores.result for scores in results)
    lines = []
    for plain, bent in zip(without.rss, edges.rss, strict=True):
        errors_db = [np.where(s.posed, s.measured_db - s.simulated_dbm, np.nan) for s in (bent, plain)]
        pair = paired_difference(*errors_db)
        low, high = pair.difference_ci95_db
        lines.append(
            f"{Path(path).stem} {plain.tower} {plain.channel}: RMSE {plain.score.rmse_db:.2f} dB,"
            f" with edges {bent.score.rmse_db:.2f}, difference {pair.difference_db:+.2f} ({low:.2f} to {high:.2f}):"
            f" {VERDICTS[pair.verdict]}"
        )
    for first, second in zip(without.rank, edges.rank, strict=True):
        both = np.isfinite(first.measured) & (first.rank[10] > 0) & (second.rank[10] > 0)
        pair = paired_difference(
            *(np.where(both, ranks.rank[10] != ranks.measured, np.nan) for ranks in (second, first)), free_offset=False
        )
        tables = (scores.rank_to_frame().set_index(["tower", "k"]) for scores in results)
        kappa = [float(table.kappa[first.tower, 10.0]) for table in tables]
        low, high = pair.mean_square_ci95_db2
        lines.append(
            f"{Path(path).stem} {first.tower} rank: kappa {kappa[0]:.3f}, with edges {kappa[1]:.3f}, disagreement"
            f" {pair.mean_square_difference_db2:+.4f} ({low:.4f} to {high:.4f}): {VERDICTS[pair.verdict]}"
        )
    return lines


def screen() -> dict[str, float]:
    """Sionna RT's level less the exact one [dB], 20 m before and 50 m behind a metal screen, at right angles to it."""
    import mitsuba
    from sionna import rt

    exact: dict[str, dict[float, float]] = {"soft": {}, "hard": {}}
    lines = (Path(__file__).parents[1] / "tests/propagation/halfplane_exact.csv").read_text().splitlines()
    for row in csv.DictReader(line for line in lines if not line.startswith("#")):
        place, shadow = (row["r0_m"], row["r_m"], row["phi0_deg"], row["dz_m"]), float(row["shadow_deg"])
        if place == ("20", "50", "90", "0") and shadow > 0.0:
            exact[row["case"]][shadow] = float(row["level_db"])
    scene = rt.load_scene()
    scene.frequency = 3.4e9
    mesh = mitsuba.Mesh("screen", vertex_count=4, face_count=2)
    buffers = mitsuba.traverse(mesh)
    corners = [-200, 0, 0, 200, 0, 0, 200, 0, -200, -200, 0, -200]
    buffers["vertex_positions"] = mitsuba.Float([float(value) for value in corners])
    buffers["faces"] = mitsuba.UInt32([0, 1, 2, 0, 2, 3])
    buffers.update()
    metal = rt.ITURadioMaterial("sheet", "metal", thickness=0.01)
    scene.add(rt.SceneObject(mi_mesh=mesh, name="screen", radio_material=metal))
    scene.add(rt.Transmitter("tower", [0.0, -20.0, 0.0]))
    for angle in exact["soft"]:
        way = np.radians(angle)
        scene.add(rt.Receiver(f"at {angle:g}", [0.0, float(50 * np.cos(way)), float(-50 * np.sin(way))]))
    rows: dict[str, float] = {}
    only = {"los": False, "specular_reflection": False, "refraction": False}
    for elements, case in (("horizontal", "soft"), ("vertical", "hard")):
        array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=elements[0].upper())
        scene.tx_array = scene.rx_array = array
        paths = rt.PathSolver()(scene, max_depth=1, diffraction=True, edge_diffraction=True, **only)
        real, imaginary = (np.asarray(part).reshape(len(exact[case]), -1) for part in paths.a)
        total = np.abs((real + 1j * imaginary).sum(axis=1))
        level = 20.0 * np.log10(total * 4.0 * np.pi * 70.0 * 3.4e9 / 299_792_458.0)
        for (angle, known), value in zip(exact[case].items(), level, strict=True):
            rows[f"{elements}, {angle:g} deg"] = round(float(value - known), 2)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--town", action="store_true")
    parser.add_argument("--sionna", action="store_true")
    parser.add_argument("--flights", nargs="*")
    parser.add_argument("--logs-root")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result: dict[str, object] = {"load": os.getloadavg()[0]}
    if options.flights is not None:
        every = (path for path in sorted(FIELD.rglob("*.yaml")) if "\nflight:" in "\n" + path.read_text())
        for path in options.flights or map(str, every):
            print(*flight(path, options.logs_root), sep="\n", flush=True)
        return
    if options.sionna:
        result["screen"] = screen()
    else:
        result["boxes"] = boxes(options.poses, options.pairs)
    if options.town:
        result["munich"] = town()
    print(json.dumps(result) if options.json else "\n".join(f"{name}: {value}" for name, value in result.items()))


if __name__ == "__main__":
    main()
