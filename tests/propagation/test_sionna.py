"""The sionna engine against the image engine, and Sionna's own arrays at short range."""

from dataclasses import replace

import numpy as np
import pytest
from shapely.geometry import box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.common.units import wavelength_m
from aerpaw_cmp.propagation.check import audit as field_audit
from aerpaw_cmp.propagation.check.audit import Second, audit
from aerpaw_cmp.propagation.field import dyads
from aerpaw_cmp.propagation.field.sum import mean_pair_power, rss_dbm
from aerpaw_cmp.propagation.geometry import rotation_from_aircraft, tower_comparison_array, uav_comparison_array
from aerpaw_cmp.propagation.options import Run, Search
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.propagation.scene import Scene
from aerpaw_cmp.site.site import Building

pytestmark = pytest.mark.sionna

SAMPLES = 100_000
BATCH = 25


@pytest.fixture(scope="module")
def case(scenes):
    rng = np.random.default_rng(41)
    court = Building("court", box(60, -90, 100, -50).difference(box(70, -80, 90, -60)), 7.0, material="metal")
    site = scenes.site(
        (*scenes.buildings(rng, 7, spread_m=100.0, holes=True)[:6], court),
        ((0.0, 0.0, 10.0), (3.0, -5.0, 20.0), (-4.0, 2.0, 9.0, 1.5)),
    )
    position = rng.uniform([-120, -120, 14], [120, 120, 50], (45, 3))
    angles = rng.uniform(-15, 15, (3, 45))
    return site, scenes.poses(position, rotation_from_aircraft(angles[0], angles[1], 12 * angles[2]))


@pytest.fixture(scope="module")
def lone(case):
    """The same with one tower: every test that can shares one set of kernels."""
    site, poses = case
    return replace(site, towers={"LW1": site.towers["LW1"]}), poses


def test_no_plugin_of_the_working_folder_is_loaded(sionna, tmp_path):
    """Mitsuba puts the working folder first, where it may find native code under the name of a shape."""
    import mitsuba as mi

    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "cylinder.so").write_bytes(b"no library")
    mi.file_resolver().prepend(str(tmp_path))  # as when the process began in this folder
    sionna.load_variant()
    assert str(tmp_path) not in str(mi.file_resolver())
    assert "Cylinder" in str(mi.load_dict({"type": "cylinder"}))


def test_both_engines_find_the_same_paths_and_fields(sionna, scenes, case):
    site, poses = case
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)))
    exact = replay(site, link, poses)
    seen = []
    traced = replay(
        site, link, poses, Search("sionna", samples=SAMPLES, batch=BATCH), run=Run(cache_dir="", progress=seen.append)
    )
    assert scenes.keys(traced.paths) == scenes.keys(exact.paths)
    assert np.nanmax(np.abs(traced.rss_dbm - exact.rss_dbm)) < 0.01
    assert traced.paths.vertices_m == pytest.approx(exact.paths.vertices_m, abs=1e-9, nan_ok=True)
    assert exact.paths.depth.max() == 2
    assert seen[-1] == 1.0
    report = audit(
        site, link, poses, exact, Search(samples=SAMPLES, batch=BATCH), run=Run(cache_dir=""), second=Second(links=75)
    )
    assert (report.reference, report.missing_paths, report.extra_paths) == ("sionna", 0, 0)


def test_too_few_samples_lose_paths_and_the_audit_says_so(sionna, scenes, lone):
    site, poses = lone
    link = scenes.link(site)
    few = replay(site, link, poses, Search("sionna", samples=100, batch=BATCH), run=Run(cache_dir=""))
    report = audit(site, link, poses, few, second=Second(links=None))
    assert report.reference == "image"
    assert report.missing_paths > 0
    assert report.extra_paths == 0


def test_audit_of_the_field_by_sionnas_own_coefficients(sionna, scenes, lone, monkeypatch):
    """Compare power, phase and both slants of each path.

    A fault of 0.1 dB or 0.011 rad in the reflections is detected.
    """
    site, poses = lone
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)))
    few = scenes.poses(poses.position_m[:BATCH], poses.rotation[:BATCH])
    expected = field_audit.Expected.of(link)
    known = {}
    ask = sionna.own_coefficients
    monkeypatch.setattr(sionna, "own_coefficients", lambda *a, **k: known.setdefault(0, known.get(0) or ask(*a, **k)))

    def audited():
        search = Search("sionna", samples=SAMPLES, batch=BATCH)
        rows = np.arange(BATCH)
        return field_audit.against_sionna(site, link, few, replay(site, link, few), rows, expected, search)

    clean = audited()
    assert clean.failures == ()
    assert clean.paths > 50
    assert clean.power_max_db < 0.03
    assert clean.phase_max_rad < 3e-3
    reflect = dyads.reflected
    for factor in (-0.1, 10 ** (0.1 / 20), np.exp(0.011j)):

        def faulty(*a, factor=complex(factor)):
            return tuple(factor * part for part in reflect(*a))

        monkeypatch.setattr(dyads, "reflected", faulty)
        assert audited().failures


def test_rays_chosen_by_pilots_find_every_path(sionna, scenes, lone):
    site, poses = lone
    traced = replay(site, scenes.link(site), poses, Search("sionna", batch=BATCH), run=Run(cache_dir=""))
    assert scenes.keys(traced.paths) == scenes.keys(replay(site, scenes.link(site), poses).paths)
    assert traced.samples in (40_000, 160_000, 640_000)
    assert "rays per tower found the same" in traced.samples_reason


def test_second_replay_traces_nothing(sionna, scenes, lone, tmp_path, monkeypatch):
    site, poses = lone
    link = scenes.link(site)
    monkeypatch.setenv("AERPAW_CMP_CACHE", str(tmp_path))  # the sionna engine caches unless this is switched off
    first = replay(site, link, poses, Search("sionna", samples=1000, batch=BATCH))

    def fail(*args, **settings):
        raise AssertionError("traced again")

    monkeypatch.setattr(sionna, "find_paths", fail)
    second = replay(site, link, poses, Search("sionna", samples=1000, batch=BATCH))
    assert (second.h == first.h).all()
    with pytest.raises(AssertionError, match="traced again"):
        replay(site, link, poses, Search("sionna", samples=1001, batch=BATCH))


def explicit_channels(sionna, scene, link, poses):
    """Return H (poses, 1, n_rx, n_tx) of one tower as Sionna computes it, with each element pair traced.

    Phases are in float32.
    """
    import mitsuba as mi
    import sionna.rt as rt

    sionna.load_variant()
    parts = {"faces": scene.faces, "links": scene.links_to(poses), "carrier_hz": link.carrier_hz, "surfaces": None}
    there = sionna._Builder(**parts).scene(np.arange(len(scene.faces))).scene
    tower, uav = next(iter(link.tower_arrays.values())), link.uav_array
    pattern = rt.antenna_pattern.antenna_pattern_registry.get("iso")(polarization="VH")
    for end, array in (("tx_array", tower), ("rx_array", uav)):
        places = array.positions_m.T / wavelength_m(link.carrier_hz)
        setattr(there, end, rt.AntennaArray(pattern, mi.Point3f(*(mi.Float(row.tolist()) for row in places))))
    ends = [
        (rt.Transmitter, scene.sources_m, tower.mount[None]),
        (rt.Receiver, poses.position_m, poses.rotation @ uav.mount),
    ]
    for kind, places, turns in ends:
        for number, (place, angles) in enumerate(zip(places, sionna._euler(turns), strict=True)):
            there.add(kind(f"{kind.__name__}{number}", position=place.tolist(), orientation=angles.tolist()))
    options = {"los": True, "specular_reflection": True, "diffuse_reflection": False, "refraction": False}
    paths = rt.PathSolver()(there, max_depth=2, samples_per_src=SAMPLES, synthetic_array=False, **options)
    gain = paths.cir(normalize_delays=False, out_type="numpy")[0][..., 0].sum(axis=-1)
    # Sionna counts polarisations outside, elements inside; a slanted element is the sum of both (TR 38.901, model 2)
    halves = gain.reshape(len(poses), 2, len(uav), 1, 2, len(tower)).astype(complex)
    h = np.einsum("rautbv,au,bv->rtuv", halves, uav.slant_parts, tower.slant_parts)
    return h.swapaxes(2, 3) if link.uav_transmits else h


def test_h_equals_sionnas_explicit_arrays_at_short_range(sionna, scenes, lone):
    """Slants, attitude, Fresnel coefficients, polarisation through reflections: all of it, to float32's phases."""
    site, poses = lone
    near = scenes.poses(poses.position_m[:BATCH] * [0.6, 0.6, 1.0], poses.rotation[:BATCH])
    link = scenes.link(
        site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)), uav_transmits=False
    )
    ours = replay(site, link, near)
    theirs = explicit_channels(sionna, Scene.of(site, link, near), link, near)
    size = np.abs(ours.h).max(axis=(2, 3))
    error = np.abs(theirs - ours.h).max(axis=(2, 3))[size > 0] / size[size > 0]
    # an element near the edge of a face may see it where the array's centre does not
    assert np.median(error) < 1e-3
    assert (error < 5e-3).mean() > 0.9
    assert np.unique(ours.paths.depth).tolist() == [0, 1, 2]


def test_rss_equals_sionnas_own_to_a_hundredth_of_a_decibel(sionna, scenes, lone):
    """Isotropic elements, whole attenuation and reflection chain of Sionna on the paths that both have."""
    site, poses = lone
    near = scenes.poses(poses.position_m * [0.5, 0.5, 1.0])
    link = scenes.link(site)
    ours = replay(site, link, near)
    h = explicit_channels(sionna, Scene.of(site, link, near), link, near)
    theirs = rss_dbm(mean_pair_power(h), link.transmit_power_dbm)
    both = np.isfinite(ours.rss_dbm)
    assert (np.isfinite(theirs) == both).all()
    assert np.abs(theirs - ours.rss_dbm)[both].max() < 0.01
    assert both.sum() > 30
    assert (np.bincount(ours.paths.pose)[both[:, 0]] > 2).any()


def test_positions_without_a_path(sionna, scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    poses = scenes.poses(
        [[40.0, 0, 4], [40.0, 0, -1], [np.nan, 0, 5], [0.0, 0, 10], [52.0, 0, 1.0], [0.0, 0, 30.0], [20.0, 0.0, 0.0]]
    )
    link = scenes.link(site)
    traced = replay(site, link, poses, Search("sionna", samples=SAMPLES, batch=BATCH), run=Run(cache_dir=""))
    exact = replay(site, link, poses)
    assert traced.has_path[:, 0].tolist() == exact.has_path[:, 0].tolist()
    assert traced.has_path[:, 0].tolist() == [False, False, False, False, False, True, True]


def test_batch_beyond_the_hash_table_is_refused(sionna, scenes):
    site = scenes.site()
    with pytest.raises(UsageError, match="batch 500"):
        replay(
            site, scenes.link(site), scenes.poses([[9.0, 0, 20]]), Search("sionna", batch=500), run=Run(cache_dir="")
        )


def test_cuda_and_llvm_agree(sionna, scenes, lone):
    import drjit as dr
    import mitsuba as mi

    if not dr.has_backend(dr.JitBackend.CUDA):
        pytest.skip("no CUDA device on this machine")
    import subprocess
    import sys

    code = (
        "import sys; from aerpaw_cmp.propagation.search import sionna; import numpy as np, pickle;"
        "from aerpaw_cmp.propagation import llvm; from aerpaw_cmp.propagation.options import Search;"
        "case = pickle.load(open(sys.argv[1], 'rb')); llvm.prepare_llvm();"
        "import mitsuba; mitsuba.set_variant(sys.argv[2] + '_ad_mono_polarized');"
        "p = sionna.find_paths(*case, Search('sionna', samples=100000, batch=25), carrier_hz=3.4e9);"
        "np.savetxt(sys.argv[3], np.column_stack([p.pose, p.tower, p.faces]), fmt='%d')"
    )
    import pickle
    import tempfile
    from pathlib import Path

    site, poses = lone
    scene = Scene.of(site, scenes.link(site), poses)
    with tempfile.TemporaryDirectory() as folder:
        entry = Path(folder) / "case"
        entry.write_bytes(pickle.dumps((scene.faces, scene.links_to(poses))))
        tables = []
        for variant in ("cuda", "llvm"):
            out = Path(folder) / variant
            subprocess.run([sys.executable, "-c", code, entry, variant, out], check=True)
            tables.append(out.read_text())
    assert tables[0] == tables[1]
    assert mi.variant()


def test_scenes_are_freed(sionna, scenes, lone):
    """Dr.Jit compiles the materials of living scenes into every kernel, and can abort the process over it."""
    import gc

    from sionna.rt import Scene

    site, poses = lone
    gc.collect()  # of tests before this one
    gc.disable()  # a scene is freed with its last user, without a search of all objects
    try:
        for height in (8.0, 9.0):
            barn = Building("barn", box(30, -10, 50, 10), height)
            replay(
                replace(site, buildings=(barn,)),
                scenes.link(site),
                poses,
                Search("sionna", samples=1000, batch=BATCH),
                run=Run(cache_dir=""),
            )
        assert not [item for item in gc.get_objects() if isinstance(item, Scene)]
    finally:
        gc.enable()


def test_coefficients_of_links_without_a_path(sionna, scenes):
    site = scenes.site([Building("barn", box(30, -10, 50, 10), 8.0)])
    poses, link = scenes.poses([[52.0, 0, 1.0]]), scenes.link(site, tower_comparison_array(), tower_comparison_array())
    probe, _ = field_audit._probe(link)
    scene = Scene.of(site, link, poses)
    coefficients = sionna.own_coefficients(
        scene.faces, scene.links_to(poses), probe, (np.eye(3)[None], poses.rotation),
        Search("sionna", samples=1000, batch=BATCH),
    )  # fmt: skip
    assert (len(coefficients.paths), coefficients.gain.shape) == (0, (0, 2, 2))


def test_a_second_search_compiles_nothing(sionna, scenes, lone):
    """Dr.Jit bakes into a kernel the alignment of NumPy's memory and every literal: positions, carrier, number of rays."""
    import drjit as dr

    site, poses = lone
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)))

    def compiled():
        return [
            kernel
            for kernel in dr.kernel_history((dr.KernelType.JIT,))
            if not kernel["cache_hit"] and not kernel["cache_disk"]
        ]

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for shift in range(4):
            compiled()
            few = type(poses)(poses.position_m[shift : shift + 5], poses.rotation[shift : shift + 5])
            # not seeded: what an earlier run left on disk must not serve
            rng = np.random.default_rng()
            other, samples = replace(link, carrier_hz=rng.uniform(3.3e9, 3.8e9)), int(rng.integers(900, 1100))
            replay(site, other, few, Search("sionna", samples=samples, batch=5, max_depth=1), run=Run(cache_dir=""))
            scene, probe = Scene.of(site, other, few), field_audit._probe(other)[0]
            sionna.own_coefficients(
                scene.faces, scene.links_to(few), probe, (np.eye(3)[None], few.rotation),
                Search("sionna", samples=samples, batch=5, max_depth=1),
            )  # fmt: skip
            big = [kernel for kernel in compiled() if kernel["operation_count"] > 1000]
            assert not (shift and big), "a search like the one before was compiled again"


def test_a_batch_without_room_is_searched_again_with_more(sionna, scenes, lone, monkeypatch):
    site, poses = lone
    link = scenes.link(site, tower_comparison_array(), uav_comparison_array(wavelength_m(scenes.carrier_hz)))

    def searched():
        search = Search("sionna", samples=10_000, batch=BATCH)
        return scenes.keys(replay(site, link, poses, search, run=Run(cache_dir="")).paths)

    usual = searched()
    monkeypatch.setattr(sionna, "MAXIMUM_PATHS", 32)  # not below the receivers of a batch: PathSolver corrupts memory
    assert searched() == usual
    monkeypatch.setattr(sionna._Finder, "_more_room", lambda _: False)
    assert len(searched()) < len(usual), "32 candidates were enough: the case is not hard"
