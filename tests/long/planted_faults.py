"""Inject faults one at a time into the replay: does the audit of a report detect them?

The flight is a thinned sample flight with the aircraft's attitude and attenuating trees, so that all parts of the replay
are used. Each fault changes one line of the package in memory, and is undone afterwards. Compiled code is switched off.
Next to the verdict of the audit, the table lists the effect of the fault on RSS, on the phase of H, and on ranks at
K = 10. A fault below 0.1 dB and 0.01 rad that changes no rank need not be detected.

Run: python -m tests.long.planted_faults [--only TEXT] [--no-sionna] [--markdown] [--json]
"""

import argparse
import dataclasses
import importlib
import inspect
import json
import os
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
P = "aerpaw_cmp.propagation"
os.environ["AERPAW_CMP_COMPILED"] = "never"


@dataclasses.dataclass(frozen=True)
class Fault:
    """``old`` becomes ``new`` in a function or method of a module."""

    name: str
    module: str
    where: str
    old: str
    new: str


FAULTS = (
    Fault("every reflection times -0.1", f"{P}.field.fresnel", 'half_space', 'return (cosine - root) / (cosine + root), (eta * cosine - root)', 'return -0.1 * (cosine - root) / (cosine + root), -0.1 * (eta * cosine - root)'),
    Fault("sign of the reflection", f"{P}.field.dyads", 'reflected', 'q = (te + tm)', 'te, tm = -te, -tm\n    q = (te + tm)'),
    Fault("conjugate carrier phase", f"{P}.field.dyads", 'received', 'np.exp(-2j', 'np.exp(2j'),
    Fault("TE and TM exchanged", f"{P}.field.dyads", 'reflected', 'q = (te + tm)', 'te, tm = tm, te\n    q = (te + tm)'),
    Fault("p component not turned with the ray", f"{P}.field.dyads", 'reflected', 'q = (te + tm)', 'q = 0.0 * (te + tm)'),
    Fault("slant mirrored", f"{P}.field.dyads", 'slant_rotation', 'return e_theta * cosine', 'sine = -sine\n    return e_theta * cosine'),
    Fault("slant of the UAV's elements left out", f"{P}.field.sum", 'Elements.of', '*_columns(uav, element))', '*_columns(uav, element))._replace(uav_slant=np.stack([np.ones(len(pair)), np.zeros(len(pair))]))'),
    Fault("1 dB on every path", f"{P}.field.dyads", 'spreading', 'return np.minimum(', 'return 1.122 * np.minimum('),
    Fault("0.11 dB on every path", f"{P}.field.dyads", 'spreading', 'return np.minimum(', 'return 1.01275 * np.minimum('),
    Fault("0.011 rad on every path", f"{P}.field.dyads", 'received', 'carrier = np.exp(', 'carrier = np.exp(0.011j) * np.exp('),
    Fault("0.011 rad on every reflection", f"{P}.field.sum", 'of_one_depth', 'cycles = length / wavelength', 'cycles = length / wavelength - g.depth[0] * 0.011 / 6.283185307179586'),
    Fault("speed of light 3e8 m/s", "aerpaw_cmp.common.units", "wavelength_m", "SPEED_OF_LIGHT_MPS", "3e8"),
    Fault("spreading over the direct distance", f"{P}.field.sum", 'of_one_depth', 'cycles = length / wavelength', 'cycles = length / wavelength\n    wave = [part * length / np.linalg.norm(g.place_m - g.image_m * [1, 1, -1], axis=1)[:, None] for part in wave]'),
    Fault("spreading missing", f"{P}.field.dyads", 'spreading', 'return np.minimum(1.0, 1.0 / (4.0 * np.pi * cycles))', 'return np.full_like(cycles, 1e-4)'),
    Fault("angle of incidence of the array's centre plus 1 degree", f"{P}.field.dyads", 'incidence', 'return np.abs(', 'return np.cos(np.pi / 180) * np.abs('),
    Fault("walls as half-spaces", f"{P}.field.fresnel", 'echo', 'finite = np.isfinite(thickness)', 'finite = np.zeros_like(np.isfinite(thickness))'),
    Fault("second echo of a slab once, not twice through", f"{P}.field.fresnel", 'echo', '-4j * np.pi', '-2j * np.pi'),
    Fault("mirrored by half the height", f"{P}.field.sum", 'geometry', 'image = image - 2.0 *', 'image = image - 1.99 *'),
    Fault("H not transposed for a transmitting UAV", f"{P}.field.sum", 'summed', 'if link.uav_transmits else matrices', 'if not link.uav_transmits else matrices'),
    Fault("foliage as 10 log of an amplitude", f"{P}.field.sum", 'summed', 'amplitude_from_db(-loss_db', 'amplitude_from_db(-2.0 * loss_db'),
    Fault("tower ports from the right", f"{P}.geometry", "_centred_line", "along_m.mean() - along_m", "along_m - along_m.mean()"),
    Fault("UAV ports row by row", f"{P}.geometry", "uav_comparison_array", "[0, half, -half], [0, -half, half]", "[0, -half, half], [0, half, -half]"),
    Fault("UAV array at a whole wavelength", f"{P}.geometry", "uav_comparison_array", "wavelength_m / 4", "wavelength_m / 2"),
    Fault("roll sign of a mount", f"{P}.geometry", "rotation_from_yaw_pitch_roll", "np.cos(roll), np.sin(roll)", "np.cos(roll), -np.sin(roll)"),
    Fault("yaw of a mount clockwise", f"{P}.geometry", "rotation_from_yaw_pitch_roll", "np.cos(yaw), np.sin(yaw)", "np.cos(yaw), -np.sin(yaw)"),
    Fault("roll sign of the aircraft", f"{P}.geometry", "rotation_from_aircraft", ", np.radians(roll_deg))", ", -np.radians(roll_deg))"),
    Fault("pitch sign of the aircraft", f"{P}.geometry", "rotation_from_aircraft", "-np.radians(pitch_deg)", "np.radians(pitch_deg)"),
    Fault("heading from south", f"{P}.geometry", "rotation_from_aircraft", "np.pi / 2 - np", "-np.pi / 2 - np"),
    Fault("heading plus 2 degrees", f"{P}.geometry", "rotation_from_aircraft", "np.pi / 2 - np", "np.radians(92.0) - np"),
    Fault("angles of the aircraft in another order", f"{P}.geometry", "rotation_from_aircraft", "-np.radians(pitch_deg), np.radians(roll_deg)", "np.radians(roll_deg), -np.radians(pitch_deg)"),
    Fault("concrete as brick", "aerpaw_cmp.site.materials", "material", "return Material(key, band,", "return Material(key, _TABLE['brick' if key == 'concrete' else key][1],"),
    Fault("ground of wet earth", "aerpaw_cmp.site.materials", "material", "return Material(key, band,", "return Material(key, _TABLE['wet_ground' if key == 'medium_dry_ground' else key][1],"),
    Fault("permittivity with a gain", "aerpaw_cmp.site.materials", "Material.relative_permittivity", "-loss)", "loss)"),
    Fault("conductivity at 1 GHz", "aerpaw_cmp.site.materials", "Material.conductivity_s_per_m", "(frequency_hz / 1e9) ** d", "1.0 ** d"),
    Fault("walls 10 % thicker", f"{P}.field.fresnel", 'face_table', 'else thickness / wavelength_m', 'else 1.1 * thickness / wavelength_m'),
    Fault("foliage 10 % stronger", f"{P}.field.foliage", "P833.loss_db", "-self.gamma_db_per_m * depth", "-1.1 * self.gamma_db_per_m * depth"),
    Fault("foliage without its largest loss", f"{P}.field.foliage", "P833.loss_db", "-self.maximum_db * np.expm1(-self.gamma_db_per_m * depth / self.maximum_db)", "self.gamma_db_per_m * depth"),
    Fault("foliage at the last entry of the table", f"{P}.field.foliage", "P833.at", "_GAMMA_EXPONENT * (mhz - inside)", "0.0 * (mhz - inside)"),
    Fault("crowns of twice the radius", f"{P}.field.foliage", "CrownIndex.__init__", "trees.crown_diameter_m / 2", "trees.crown_diameter_m"),
    Fault("crowns from the ground", f"{P}.field.foliage", "CrownIndex.__init__", "base = trees.ground_m + trees.crown_base_m", "base = trees.ground_m + 0.0 * trees.crown_base_m"),
    Fault("crowns as cylinders", f"{P}.field.foliage", "CrownIndex.__init__", "self.shape: Shape = shape", "self.shape: Shape = 'cylinder'"),
    Fault("one segment of a path without foliage", f"{P}.field.foliage", "foliage_depth_m", "vertices, target)]):", "vertices, target)][1:]):"),
    Fault("paths of two reflections dropped", f"{P}.search.mirror", "find_paths", "for level in levels:", "for level in levels[:2]:"),
    Fault("every fifth path dropped", f"{P}.search.mirror", "find_paths", "return merge(pieces, max_depth, faces)", "return (lambda p: p.select(np.arange(len(p)) % 5 > 0))(merge(pieces, max_depth, faces))"),
    Fault("direct paths dropped", f"{P}.search.mirror", "find_paths", "for level in levels:", "for level in levels[1:]:"),
    Fault("nothing hides", f"{P}.search.mirror", "Occlusion.segments", "if not self.pieces:", "if self.pieces:"),
    Fault("walls 5 m longer than they are", f"{P}.geometry", "inside", "(faces.upper + tolerance_m)", "(faces.upper + 5.0)"),
    Fault("reflection points off by 1 % of the way", f"{P}.search.mirror", "trace_back", "share = behind / (behind + ahead)", "share = 0.99 * behind / (behind + ahead)"),
    Fault("walls moved by 5 cm", f"{P}.geometry", "_walls", "offset_m=(normal[:, :2] * start).sum(axis=1)", "offset_m=(normal[:, :2] * start).sum(axis=1) + 0.05"),
    Fault("antenna 30 cm higher", "aerpaw_cmp.site.site", "Tower.position_m", "self.ground_m + self.antenna_height_m", "self.ground_m + self.antenna_height_m + 0.3"),
    Fault("power summed over the receiving ports", f"{P}.field.sum", "mean_pair_power", "parts, parts) / pairs)", "parts, parts) / pairs * h.shape[-2])"),
    Fault("transmit power 1 dB more", f"{P}.field.sum", "rss_dbm", "transmit_power_dbm + db", "transmit_power_dbm + 1.0 + db"),
    Fault("K compared with powers", "aerpaw_cmp.compare.rank", "rank_from_singular_values", "(1.0 / k + margin)", "(1.0 / k**2 + margin)"),
)  # fmt: skip


# ---------------------------------------------------------------- planting


@contextmanager
def planted(fault: Fault) -> Iterator[None]:
    """The package with one fault."""
    undo: list[Callable[[], None]] = []
    try:
        _plant(fault, undo)
        _forget()
        yield
    finally:
        for step in reversed(undo):
            step()
        _forget()


def _forget() -> None:
    """Restore the functions that the package caches."""
    from aerpaw_cmp.propagation import geometry as faces
    from aerpaw_cmp.propagation.field import foliage

    faces._faces.cache_clear()
    foliage.crown_index.cache_clear()


def _target(fault: Fault) -> tuple[Any, Any, str, Any, str]:
    """Module and owner of a fault's function, its name, the function and its source.

    Raises
    ------
    LookupError
        The code has changed.
    """
    module = importlib.import_module(fault.module)
    owner: Any = module
    *outer, name = fault.where.split(".")
    try:
        for part in outer:
            owner = getattr(owner, part)
        raw = owner.__dict__[name] if outer else getattr(module, name)
    except (AttributeError, KeyError):
        raise LookupError(f"{fault.name}: there is no {fault.module}.{fault.where}") from None
    source = textwrap.dedent(inspect.getsource(_function(raw)))
    if fault.old not in source:
        raise LookupError(f"{fault.name}: '{fault.old}' is not in {fault.module}.{fault.where}")
    return module, owner, name, raw, source


def stale() -> list[str]:
    """Faults whose line is not in the code any more."""
    lines = []
    for fault in FAULTS:
        try:
            _target(fault)
        except LookupError as error:
            lines.append(str(error))
    return lines


def _plant(fault: Fault, undo: list[Callable[[], None]]) -> None:
    module, owner, name, raw, source = _target(fault)
    scope: dict[str, Any] = {}
    code = compile("from __future__ import annotations\n" + source.replace(fault.old, fault.new), fault.where, "exec")
    exec(code, module.__dict__ | {"__name__": module.__name__}, scope)
    new = scope[name]
    setattr(owner, name, new)
    undo.append(lambda: setattr(owner, name, raw))
    if owner is not module:
        return
    # who imported the function by name has it too
    for other in list(sys.modules.values()):
        if getattr(other, "__name__", "").startswith("aerpaw_cmp") and other is not module:
            for attribute, value in list(vars(other).items()):
                if value is raw:
                    setattr(other, attribute, new)
                    undo.append(lambda other=other, attribute=attribute: setattr(other, attribute, raw))


def _function(raw: Any) -> Any:
    if isinstance(raw, property):
        return raw.fget
    return raw.__func__ if isinstance(raw, (classmethod, staticmethod)) else raw


# ---------------------------------------------------------------- the flight


def sample_flight(every: int = 40) -> Any:
    """The sample flight with attitude and trees, of three series: one tower's two channels, another's, and the rank."""
    from aerpaw_cmp.flight.data import gather, read_logs
    from aerpaw_cmp.flight.settings import load_flight

    file = ROOT / "sample_logs" / "flight.yaml"
    settings = load_flight(file)
    knobs = settings.rt.advanced.model_copy(update={"samples": 100_000})
    rt = settings.rt.model_copy(
        update={"attitude": "logged", "foliage": "attenuating", "audit_links": 60, "advanced": knobs}
    )
    settings = settings.model_copy(update={"rt": rt, "rss": settings.rss.model_copy(update={"lag": "off"})})
    data = gather(settings, file.parent, read_logs(settings, file.parent, None), None)
    chosen = [s for s in data.rss if (s.tower, s.channel) in {("LW1", "USRP2"), ("LW3", "USRP1"), ("LW4", "USRP2")}]
    sparse = [dataclasses.replace(s, time=s.time[::every], measured_db=s.measured_db[::every]) for s in chosen]
    rank = [
        dataclasses.replace(
            s,
            time=s.time[::every],
            rank=s.rank[::every],
            sinr_db=s.sinr_db[::every],
            position_m=None if s.position_m is None else s.position_m[::every],
        )
        for s in data.rank
    ]
    site = dataclasses.replace(data.site, trees=_stand([data.site.towers[s.tower] for s in chosen]))
    return dataclasses.replace(data, site=site, rss=tuple(sparse), rank=tuple(rank))


def _stand(towers: list[Any]) -> Any:
    """Tall trees round the towers, so that foliage is on many paths."""
    from aerpaw_cmp.site.site import Trees

    rng = np.random.default_rng(5)
    place = np.concatenate([rng.uniform(-120, 120, (150, 2)) + t.position_m[:2] for t in towers])
    like = np.ones(len(place))
    return Trees(place[:, 0], place[:, 1], 0 * like, 25 * like, 8 * like, 4 * like, 0.4 * like)


@dataclasses.dataclass(frozen=True)
class Change:
    """Return the effect of a fault on the replay: largest changes, and links with another rank at K = 10."""

    rss_db: float
    phase_rad: float
    ranks: int

    @property
    def counts(self) -> bool:
        """Check whether the audit has to detect the fault."""
        return self.rss_db > 0.1 or self.phase_rad > 0.01 or self.ranks > 0


def replays_of(data: Any) -> Any:
    """All series, replayed."""
    from aerpaw_cmp.flight.replay import replay_flight

    return replay_flight(data).all


def ranks_of(replays: Any) -> list[Any]:
    """Ranks at K = 10 of each replay, by the package's own count."""
    from aerpaw_cmp.compare.rank import channel_rank

    return [channel_rank(replayed.replay.h, 10.0) for replayed in replays]


def change(clean: Any, faulty: Any, clean_ranks: list[Any], faulty_ranks: list[Any]) -> Change:
    """Return the changes of the faulty replay from the clean replay."""
    rss = phase = 0.0
    for before, after in zip(clean, faulty, strict=True):
        a, b = before.replay, after.replay
        covered = np.isfinite(a.rss_dbm) != np.isfinite(b.rss_dbm)
        both = np.isfinite(a.rss_dbm) & np.isfinite(b.rss_dbm)
        rss = max(rss, np.inf if covered.any() else 0.0, np.abs(a.rss_dbm - b.rss_dbm)[both].max(initial=0.0))
        if a.h.shape != b.h.shape:
            return Change(rss, np.inf, len(a.h))
        strong = np.abs(a.h) > 0.1 * np.abs(a.h).max(axis=(2, 3), keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = np.abs(np.angle(b.h / a.h))
        phase = max(phase, float(np.nan_to_num(turn[strong]).max(initial=0.0)))
    ranks = sum(int((a != b).sum()) for a, b in zip(clean_ranks, faulty_ranks, strict=True))
    return Change(float(rss), phase, ranks)


def failures(data: Any, replays: Any, *, sionna: bool = True) -> list[str]:
    """Return the failures of the audit that ``report --strict`` would name."""
    from aerpaw_cmp.jobs import audit_flight

    if sionna:
        audit = audit_flight.audit_replays(data, replays).audit
        assert audit is not None
        assert audit.fields is not None
        lost = [f"the engine misses {audit.missing_paths} paths"] if audit.missing_paths else []
        return [*lost, *audit.fields.failures]
    return list(reference_only(data, replays).failures)


def reference_only(data: Any, replays: Any) -> Any:
    """The audit without Sionna: the second implementation and the attitude."""
    from aerpaw_cmp.jobs.audit_flight import attitude_checked, expectations
    from aerpaw_cmp.propagation.check.audit import against_reference, spread_over_paths

    total = attitude_checked(data, replays)
    for replayed, expected in zip(replays, expectations(data, replays), strict=True):
        chosen = spread_over_paths(replayed.replay, np.arange(0, len(replayed.poses), 2), 4)
        total += against_reference(
            data.site,
            replayed.poses,
            replayed.replay,
            chosen,
            expected,
            ks=(10.0,),
            max_depth=data.settings.rt.max_depth,
        )
    return total


def remembered() -> None:
    """Sionna's answers do not change with the faults: the same question is asked once."""
    from aerpaw_cmp.propagation.search import sionna

    known: dict[bytes, Any] = {}
    ask = sionna.own_coefficients

    def own_coefficients(faces: Any, links: Any, probe: Any, turns: Any, rays: Any, **options: Any) -> Any:
        ends = links.sources_m, links.targets_m, links.usable
        arrays = (faces.normal, faces.offset_m, faces.lower, faces.upper, *ends, *turns)
        slants = [a.slant_rad for a in (*probe.tower_arrays.values(), probe.uav_array)]
        key = b"".join(np.ascontiguousarray(a).tobytes() for a in (*arrays, *slants))
        key += repr((probe.carrier_hz, faces.material)).encode()
        if key not in known:
            known[key] = ask(faces, links, probe, turns, rays, **options)
        return known[key]

    sionna.own_coefficients = own_coefficients


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="faults whose name contains this")
    parser.add_argument("--every", type=int, default=40, help="each so-manieth sample of the flight")
    parser.add_argument("--no-sionna", action="store_true", help="the second implementation alone")
    parser.add_argument("--markdown", action="store_true", help="the table for docs/numerics.md")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--stale", action="store_true", help="only say which faults are not in the code any more")
    options = parser.parse_args()
    if lines := stale():
        raise SystemExit("\n".join(lines))
    if options.stale:
        return 0
    data = sample_flight(options.every)
    clean = replays_of(data)
    clean_ranks = ranks_of(clean)
    if not options.no_sionna:
        remembered()
    started = time.perf_counter()
    false_alarms = failures(data, clean, sionna=not options.no_sionna)
    print(f"clean: {false_alarms or 'no failure'}, {time.perf_counter() - started:.1f} s", file=sys.stderr)
    rows = []
    for fault in (f for f in FAULTS if options.only in f.name):
        with planted(fault):
            faulty = replays_of(data)
            try:
                named = failures(data, faulty, sionna=not options.no_sionna)
            except Exception as error:  # Sionna refuses such a material, say: that is loud enough
                named = [f"refused: {type(error).__name__}: {str(error).splitlines()[0][:100]}"]
            faulty_ranks = ranks_of(faulty)
        effect = change(clean, faulty, clean_ranks, faulty_ranks)
        rows.append({"fault": fault.name, **dataclasses.asdict(effect), "counts": effect.counts, "caught": bool(named),
                     "failures": len(named), "first": named[0] if named else ""})  # fmt: skip
        print(rows[-1], file=sys.stderr)
    result = {
        "false_alarms": false_alarms,
        "faults": len(rows),
        "that_count": sum(r["counts"] for r in rows),
        "caught": sum(r["caught"] for r in rows if r["counts"]),
        "rows": rows,
    }
    if options.markdown:
        print("| fault | RSS [dB] | phase [rad] | ranks, K = 10 | caught |\n| --- | --- | --- | --- | --- |")
        for r in rows:
            print(
                f"| {r['fault']} | {r['rss_db']:.2g} | {r['phase_rad']:.2g} | {r['ranks']} | {'yes' if r['caught'] else 'no'} |"
            )
    print(json.dumps(result) if options.json else f"{result['caught']} of {result['that_count']} that count are caught")
    return int(bool(false_alarms) or result["caught"] < result["that_count"])


if __name__ == "__main__":
    sys.exit(main())
