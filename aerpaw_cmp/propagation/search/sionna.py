"""A path finder with Sionna RT. This is the only file that imports sionna, mitsuba and drjit.

Sionna computes in float32 and finds paths by sampling. Only *the sequence of faces of a path* is taken from Sionna.
Reflection points are computed by the image method in float64, and fields by :mod:`aerpaw_cmp.propagation.field.sum`.

This module guards against silent errors of Sionna RT 2.2.0:

- Its hash table of candidates is shared by all receivers of a call and loses paths. Therefore this module uses a table
  of 2**24 slots and batches of at most 100 poses.
- It drops candidates beyond ``max_num_paths_per_src``, most of which are not paths in the end. It corrupts memory if
  that limit is below the number of receivers. Sionna's own count of candidates is therefore read after each batch. If a
  batch exceeded the limit, or filled too much of the table, it is searched again with larger limits.
- If positions are given as numbers, kernels are compiled again for each position. Positions are therefore arrays here,
  and each batch has the same size (the last batch is padded).
- A line of sight without Friis' amplitude, or a path with a gain above one, stops the run.
"""

from __future__ import annotations

import gc
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np

from ...common.errors import CheckError, UsageError
from ...common.units import BoolArray, ComplexArray, FloatArray, IntArray, wavelength_m
from ...site.materials import material
from ..geometry import Faces, Link, Links, PathSet, Surfaces, inside, path_lengths, triangles
from ..llvm import INSTALL_AGAIN, SionnaMissingError, let_sionna_load, prepare_llvm
from ..options import Progress, Search
from .mirror import MINIMUM_LENGTH_M, merge, planes_of, retraced, scene_tolerance_m, searched_links

SPECULAR_TABLE_SLOTS = 2**24
_FEWEST_SLOTS = 2**20
# Initial limit on the number of candidates per tower and batch. The actual number is known only afterwards.
MAXIMUM_PATHS = 2**16

# Number of candidates above which a batch is refused. A candidate needs about 100 bytes.
_MOST_CANDIDATES = 2**25

# Share of the table that candidates may fill. Each candidate has two hashes, so the share of lost candidates is about
# twice this.
_FULLEST_TABLE = 1 / 32

# Largest number of slots of the table, over all towers of a call. A slot needs 4 bytes in each of two tables.
_MOST_SLOTS = 2**28

_LARGEST_BATCH = 100
# Thickness of a half-space for Sionna, which supports only slabs: a slab this thick has no second echo. H is not
# computed from Sionna's coefficients.
HALF_SPACE_THICKNESS_M = 10.0
# Largest distance of a float32 reflection point outside its face [m].
_EDGE_TOLERANCE_M = 1e-3

# Scenes in use. No old scene may exist when the next scene is created: Dr.Jit compiles virtual calls for every existing
# material, including materials of unused scenes, and may then define a function twice and abort the process.
_ALIVE: WeakSet[Any] = WeakSet()

# Variants of Mitsuba, the preferred variant first.
_VARIANTS = ("cuda_ad_mono_polarized", "llvm_ad_mono_polarized")


def load_variant() -> str:
    """Choose CUDA if there is a GPU, else LLVM, and return the name of the variant.

    A variant that is already set is kept, because after a change, objects of two kinds would exist.

    Raises
    ------
    SionnaMissingError
        If Sionna RT or a package that it needs is not installed or damaged, no LLVM works, or Dr.Jit finds no device.
    """
    let_sionna_load()
    without_llvm: SionnaMissingError | None = None
    try:
        prepare_llvm()  # call this before Dr.Jit searches for a library
    except SionnaMissingError as error:
        without_llvm = error  # a GPU does not need LLVM
    try:
        import drjit as dr
        import mitsuba as mi
    except Exception as error:
        raise _missing(error) from error
    # Mitsuba first searches the working folder for plugins. Plugins are native code, possibly from a third party.
    resolver: Any = mi.file_resolver
    resolver().clear()
    resolver().append(str(Path(mi.__file__).parent))
    if mi.variant() not in _VARIANTS:
        has_cuda = dr.has_backend(dr.JitBackend.CUDA)
        if without_llvm and not has_cuda:
            raise without_llvm
        if not has_cuda and not dr.has_backend(dr.JitBackend.LLVM):
            raise SionnaMissingError("Dr.Jit finds no device", cause="'aerpaw-cmp doctor' shows what is missing")
        mi.set_variant(_VARIANTS[0 if has_cuda else 1])
    return str(mi.variant())


def _missing(error: Exception) -> SionnaMissingError:
    """Return the error for an import that failed. The import of a damaged package may raise any exception."""
    if isinstance(error, ModuleNotFoundError):
        return SionnaMissingError(f"Sionna RT is not installed ({error}). Install it with: pip install sionna-rt")
    return SionnaMissingError(f"Sionna RT cannot be loaded ({error}). Repair it with: {INSTALL_AGAIN}")


def free_memory() -> None:
    """Free the memory that Dr.Jit keeps for further searches, if it was loaded."""
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()


@dataclass(frozen=True, slots=True)
class _Scene:
    """A Sionna scene, and the face of each of its triangles."""

    scene: Any
    face_of: dict[int, IntArray]  # face of each triangle, by the id of the object


@dataclass(frozen=True, slots=True, kw_only=True)
class _Builder:
    """A builder of Sionna scenes from some of the faces, with one mesh per material.

    With ``own_table``, a scene has Sionna's own constants of P.2040.
    """

    faces: Faces
    links: Links
    carrier_hz: float
    surfaces: Surfaces | None
    own_table: bool = False

    def scene(self, chosen: IntArray) -> _Scene:
        """Return the scene of the faces ``chosen``."""
        import drjit as dr

        try:
            import sionna.rt as rt
        except Exception as error:
            raise _missing(error) from error
        if _ALIVE:
            gc.collect()  # an exception may still keep a scene alive
        scene, faces = rt.load_scene(), self.faces
        _ALIVE.add(scene)
        scene.frequency = self.carrier_hz
        ends = np.concatenate([self.links.sources_m, self.links.targets_m])
        # extend the ground only as far as reflections can be, because float32 coordinates become coarse
        reach = 4.0 * float(max(np.nanmax(np.abs(ends)), 100.0))
        vertices, triangle, owner = triangles(faces, reach) if self.surfaces is None else self.surfaces.mesh()
        objects, owners = [], []
        for name in dict.fromkeys(faces.material[i] for i in chosen):
            members = [i for i in chosen if faces.material[i] == name]
            rows = np.flatnonzero(np.isin(owner, members))
            plain = f"faces-{_plain(name)}"
            material = _material(name, self.carrier_hz, self.own_table)
            # create a mesh per material, not per face, because Dr.Jit compiles code for the contents of a scene
            mesh = self._mesh(plain, vertices, triangle[rows])
            objects.append(rt.SceneObject(mi_mesh=mesh, name=plain, radio_material=material))
            owners.append(owner[rows])
        scene.edit(add=objects)
        # pass the values as data, because code with literals would be compiled again for each carrier
        materials = scene.radio_materials.values()
        dr.make_opaque(scene.frequency, *((m.relative_permittivity, m.conductivity) for m in materials))
        return _Scene(scene, {int(o.object_id): f for o, f in zip(objects, owners, strict=True)})

    def _mesh(self, name: str, vertices: FloatArray, triangle: IntArray) -> Any:
        import mitsuba as mi

        corners, place = np.unique(triangle, return_inverse=True)
        # use only the corners of these triangles: otherwise all corners would be sent to the device for each material
        points = vertices[corners]
        mesh = mi.Mesh(name, vertex_count=len(points), face_count=len(triangle))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(points, np.float32).ravel())
        parameters["faces"] = mi.UInt32(place.astype(np.uint32).ravel())
        parameters.update()
        return mesh


def _plain(name: str) -> str:
    """Return a name that Mitsuba accepts."""
    return re.sub(r"[^a-z0-9_]+", "-", name)


def _material(name: str, carrier_hz: float, own_table: bool) -> Any:
    import sionna.rt as rt

    what = material(name)
    eta = what.relative_permittivity(carrier_hz)
    thick, plain = HALF_SPACE_THICKNESS_M if what.thickness_m is None else what.thickness_m, _plain(name)
    if own_table:
        from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

        if name.partition(" with ")[0] in ITU_MATERIALS_PROPERTIES:
            return rt.ITURadioMaterial(f"m-{plain}", name.partition(" with ")[0], thickness=thick)
    # convert to the conductivity [S/m] that Sionna expects
    conductivity = -eta.imag * 2.0 * np.pi * carrier_hz * 8.8541878128e-12
    return rt.RadioMaterial(
        f"m-{plain}", thickness=thick, relative_permittivity=float(eta.real), conductivity=float(conductivity)
    )


def _slots(built: _Scene, targets: int) -> int:
    """Return the number of slots of PathSolver's table. Bare ground needs fewer, as there are few candidates.

    Of n candidates, about ``2 n^2 / slots`` are lost: less than one in two hundred batches.
    """
    mirrors = sum(len(np.unique(faces)) for faces in built.face_of.values())
    slots = 400.0 * (targets * max(mirrors, 1) ** 2) ** 2
    return int(np.clip(2 ** np.ceil(np.log2(slots)), _FEWEST_SLOTS, SPECULAR_TABLE_SLOTS))


def _points(values: FloatArray) -> Any:
    import mitsuba as mi

    # use lists: Dr.Jit would use the memory of NumPy arrays directly, and compile again for each alignment
    return mi.Point3f(*(mi.Float(column) for column in values.T.astype(np.float32).tolist()))


@dataclass(frozen=True, slots=True)
class _Ends:
    """Devices with one element each, for PathSolver: centres (devices, 3) and rotations (devices, 3, 3)."""

    centres_m: FloatArray
    turns: FloatArray

    @classmethod
    def points(cls, centres_m: FloatArray) -> _Ends:
        """Return devices without rotation."""
        return cls(centres_m, np.tile(np.eye(3), (len(centres_m), 1, 1)))

    def arguments(self) -> tuple[Any, Any, Any]:
        """Return positions, orientations and element offsets."""
        return _points(self.centres_m), _points(_euler(self.turns)), _points(np.zeros_like(self.centres_m))

    def padded(self, count: int) -> _Ends:
        """Repeat the last device until there are ``count``."""
        rows = np.minimum(np.arange(count), len(self.centres_m) - 1)
        return _Ends(self.centres_m[rows], self.turns[rows])


def _euler(turns: FloatArray) -> FloatArray:
    """Return (yaw, pitch, roll) of rotations, TR 38.901 eq. (7.1-4)."""
    yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
    pitch = -np.arcsin(np.clip(turns[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(turns[:, 2, 1], turns[:, 2, 2])
    return np.asarray(np.stack([yaw, pitch, roll], axis=1))


class _Finder:
    """PathSolver with fixed-size batches of targets.

    Parameters
    ----------
    built : _Scene
    sources : _Ends
    batch : int
    patterns : (str, str)
        Sionna's names for the patterns of the elements at the sources and at the targets.
    """

    def __init__(
        self, built: _Scene, sources: _Ends, batch: int, *, patterns: tuple[str, str] = ("iso", "iso")
    ) -> None:
        import sionna.rt as rt
        from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

        self.built, self.batch = built, batch
        scene = built.scene
        for name, kind in zip(("tx_array", "rx_array"), patterns, strict=True):
            # use both polarisations, from which all slants are computed without another search
            pattern = rt.antenna_pattern.antenna_pattern_registry.get(kind)(polarization="VH")
            setattr(scene, name, rt.AntennaArray(pattern, _points(np.zeros((1, 3)))))
        for i in range(len(sources.centres_m)):
            # the positions do not matter: Sionna only counts these devices, and their positions are set later as arrays
            scene.add(rt.Transmitter(name=f"tx{i}", position=[0.0, 0.0, 1.0]))
        for i in range(batch):
            scene.add(rt.Receiver(name=f"rx{i}", position=[0.0, 0.0, 1.0]))
        self.limit, self.slots = MAXIMUM_PATHS, _slots(built, batch)
        self.candidates: Any = None  # PathSolver fills it
        SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = self.slots
        self.sources = sources.arguments()
        self.targets = _Ends.points(np.zeros((batch, 3))).arguments()
        self._replace_endpoints(len(sources.centres_m))
        self.solver = rt.PathSolver()
        self._watch_candidates()
        self._share_kernels()

    def _watch_candidates(self) -> None:
        """Store PathSolver's own count of candidates per source, which also counts candidates beyond its limit."""
        generator = self.solver._candidate_generator
        inner = generator._shoot_and_bounce
        place = list(inspect.signature(inner).parameters).index("paths_counter_per_source")

        def watched(*arguments: Any, **named: Any) -> Any:
            counter = arguments[place] if len(arguments) > place else None
            self.candidates = named.get("paths_counter_per_source", counter)
            return inner(*arguments, **named)

        generator._shoot_and_bounce = watched

    def _share_kernels(self) -> None:
        """Pass ray directions to kernels as data. Otherwise, a new number of rays would require new kernels."""
        import drjit as dr
        import sionna.rt.path_solvers.sb_candidate_generator as generator
        from sionna.rt.utils import fibonacci_lattice

        def lattice(count: int) -> Any:
            directions = fibonacci_lattice(count)
            dr.eval(directions)
            return directions

        generator.fibonacci_lattice = lattice
        field = self.solver._field_calculator
        # the number affects diffuse rays only, which no search uses
        self.solver._field_calculator = lambda **named: field(**named | {"samples_per_src": 1})

    def _replace_endpoints(self, towers: int) -> None:
        """Give PathSolver arrays of positions, because the positions of devices would be literals in the kernels."""
        import drjit as dr
        import mitsuba as mi

        # replace public methods, whose results are documented
        def sources(synthetic_array: bool, return_velocities: bool) -> tuple[Any, Any, Any, Any]:  # noqa: ARG001
            return *self.sources, dr.zeros(mi.Vector3f, towers) if return_velocities else None

        def targets(synthetic_array: bool, return_velocities: bool) -> tuple[Any, Any, Any, Any]:  # noqa: ARG001
            return *self.targets, dr.zeros(mi.Vector3f, self.batch) if return_velocities else None

        self.built.scene.sources, self.built.scene.targets = sources, targets

    def __enter__(self) -> _Finder:
        return self

    def __exit__(self, *error: object) -> None:
        """Remove the references between scene and finder, so that both are freed after their last use."""
        scene = self.built.scene
        del scene.sources, scene.targets
        for name in (*scene.transmitters, *scene.receivers):
            scene.remove(name)
        scene.edit(remove=list(scene.objects))  # before Sionna RT 2.2, this was the only way to remove an object
        self.built, self.solver = None, None  # type: ignore[assignment]

    def trace(self, targets: _Ends, search: Search) -> Any:
        """Search Sionna's paths of one padded batch. Increase the limits until all candidates fit."""
        self.targets = targets.padded(self.batch).arguments()
        paths = self._solved(search)
        # lines of sight do not need a table
        while search.max_depth and self._more_room():
            paths = self._solved(search)
        return paths

    def _solved(self, search: Search) -> Any:
        return self.solver(
            self.built.scene,
            max_depth=search.max_depth,
            max_num_paths_per_src=self.limit,
            samples_per_src=int(search.samples),
            synthetic_array=True,
            los=True,
            specular_reflection=search.max_depth > 0,
            diffuse_reflection=False,
            refraction=False,
            diffraction=False,
        )

    def _more_room(self) -> bool:
        """Check whether the last batch exceeded the limits on candidates, and increase the limits if it did."""
        from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator

        most = 0 if self.candidates is None else int(np.asarray(self.candidates.numpy()).max(initial=0))
        slots = self.slots
        # double the number of slots, which must be a power of two
        while most > _FULLEST_TABLE * slots:
            slots *= 2
        slots = max(self.slots, min(slots, _MOST_SLOTS // max(1, len(self.built.scene.transmitters))))
        limit = self.limit
        while most > limit:
            limit *= 2
        if limit > _MOST_CANDIDATES:
            raise CheckError(
                f"a batch has {most} candidates of a path for one tower, more than PathSolver can store",
                expected=f"at most {_MOST_CANDIDATES}",
                cause="use fewer samples or a smaller batch, or engine 'image'",
            )
        if (limit, slots) == (self.limit, self.slots):
            return False
        self.limit, self.slots = limit, slots
        SBCandidateGenerator.MIN_SPEC_COUNT_SIZE = slots
        return True

    def searched(self, targets_m: FloatArray, search: Search) -> dict[str, Any]:
        """Return Sionna's paths of one batch, without padding: valid, kind, shape, primitive, gain."""
        count = len(targets_m)
        paths = self.trace(_Ends.points(targets_m), search)
        real, imaginary = (np.asarray(part.numpy()) for part in paths.a)
        valid = paths.valid.numpy()
        if valid.sum(axis=(0, 2)).max(initial=0) > 0.9 * self.limit:
            raise CheckError(
                f"a tower has nearly {self.limit} paths in one batch, beyond which Sionna drops paths",
                cause="use a smaller batch",
            )
        # sum over both polarisations at both ends
        gain = np.sqrt((real**2 + imaginary**2).sum(axis=(1, 3)))[:count]
        return _arrays(paths, count) | {"gain": gain}


def _arrays(paths: Any, count: int) -> dict[str, Any]:
    """Return the validity of Sionna's paths to the first ``count`` targets, and the objects that they hit."""
    return {
        "valid": paths.valid.numpy()[:count],
        "kind": paths.interactions.numpy()[:, :count],
        "shape": paths.objects.numpy()[:, :count],
        "primitive": paths.primitives.numpy()[:, :count],
    }


def _each_batch(
    make: Callable[[IntArray, IntArray], _Finder], groups: Iterable[tuple[IntArray, IntArray]], alive: BoolArray
) -> Iterator[tuple[_Finder, IntArray, IntArray]]:
    """Yield finder, towers and poses of every batch of links that are ``alive`` (towers, poses).

    Only one scene exists at a time. ``make(towers, faces)`` creates it for a group of towers that share it.
    """
    for towers, chosen in groups:
        poses = np.flatnonzero(alive[towers].any(axis=0))
        if not len(poses):
            continue
        with make(towers, chosen) as finder:
            for start in range(0, len(poses), finder.batch):
                yield finder, towers, poses[start : start + finder.batch]


def find_paths(
    faces: Faces,
    links: Links,
    search: Search,
    *,
    carrier_hz: float,
    surfaces: Surfaces | None = None,
    progress: Progress | None = None,
) -> PathSet:
    """Return paths that Sionna's PathSolver finds, refined in float64.

    Parameters
    ----------
    faces : Faces
    links : Links
    search : Search
        Depth, rays and batch.
    carrier_hz : float
        Carrier frequency. Sionna samples rays by reflected power, so the materials at this frequency affect its search.
    surfaces : Surfaces, optional
        Triangles of the faces, if they are open surfaces.
    progress : callable, optional

    Returns
    -------
    PathSet
        Paths, sorted by pose, tower, depth and faces.
    """
    sources_m, targets_m, batch = links.sources_m, links.targets_m, search.batch
    if not 1 <= batch <= _LARGEST_BATCH:
        raise UsageError(f"batch {batch}", expected=f"1 to {_LARGEST_BATCH} poses per call")
    tolerance_m = scene_tolerance_m(faces, sources_m, targets_m)
    load_variant()
    builder = _Builder(faces=faces, links=links, carrier_hz=carrier_hz, surfaces=surfaces)

    def make(towers: IntArray, chosen: IntArray) -> _Finder:
        return _Finder(builder.scene(chosen), _Ends.points(sources_m[towers]), batch)

    groups, alive, traced = list(_groups(faces, sources_m, links.usable)), searched_links(links), 0
    count = sum(int(alive[towers].any(axis=0).sum()) for towers, _ in groups)
    pieces = []
    for finder, towers, some in _each_batch(make, groups, alive):
        raw = finder.searched(targets_m[some], search)
        _check_gain(raw, sources_m[towers], targets_m[some], carrier_hz)
        receiver, tower, _, sequence = _sequences(raw, finder.built.face_of, search.max_depth)
        pieces.append(
            _refine(faces, sources_m, targets_m, some[receiver], towers[tower], sequence, tolerance_m, surfaces)
        )
        traced += len(some)
        if progress:
            progress(traced / count)
    paths = merge(pieces, search.max_depth, faces if surfaces is None else None)
    if surfaces is not None:
        from .beams import without_coincident

        paths = without_coincident(paths, surfaces)
    return paths if links.excluded is None else paths.select(~links.excluded[paths.tower, paths.pose])


@dataclass(frozen=True, slots=True)
class Coefficients:
    """Paths and coefficients of Sionna without refinement.

    Parameters
    ----------
    paths : PathSet
        Paths with Sionna's reflection points.
    gain : (paths, 2, 2) complex
        Coefficients (UAV elements, tower elements), including the carrier phase.
    length_m : (paths,)
        Length along Sionna's reflection points, in float64.
    """

    paths: PathSet
    gain: ComplexArray
    length_m: FloatArray


def own_coefficients(
    faces: Faces,
    links: Links,
    probe: Link,
    turns: tuple[FloatArray, FloatArray],
    search: Search,
    *,
    surfaces: Surfaces | None = None,
) -> Coefficients:
    """Return Sionna's complex coefficient of each path, for the audit of the field.

    The constants of P.2040, rotations, patterns, slants, Fresnel coefficients and spreading all come from Sionna. Only
    the carrier phase is computed here, from the path length in float64, because Sionna would compute ``2 pi f tau`` in
    float32.

    Parameters
    ----------
    faces, links, search, surfaces
        The same as in :func:`find_paths`.
    probe : Link
        Link with two elements of one pattern at the centre of each array.
    turns : ((towers, 3, 3), (poses, 3, 3))
        Rotations from device to site, for the towers' arrays and for the UAV's array at each pose.

    Returns
    -------
    Coefficients
    """
    load_variant()
    sources_m, targets_m = links.sources_m, links.targets_m
    arrays = list(probe.tower_arrays.values())
    pattern = np.array([array.patterns[0].name for array in arrays])
    builder = _Builder(faces=faces, links=links, carrier_hz=probe.carrier_hz, surfaces=surfaces, own_table=True)

    def make(towers: IntArray, chosen: IntArray) -> _Finder:
        ends = _Ends(sources_m[towers], turns[0][towers])
        names = str(pattern[towers[0]]), probe.uav_array.patterns[0].name
        return _Finder(builder.scene(chosen), ends, search.batch, patterns=names)

    groups = (
        (sharing[pattern[sharing] == name], chosen)
        for sharing, chosen in _groups(faces, sources_m, links.usable)
        for name in dict.fromkeys(pattern[sharing].tolist())
    )
    pieces: list[PathSet] = []
    gains: list[ComplexArray] = []
    slants = np.stack([array.slant_parts for array in arrays])
    every = np.ones((len(sources_m), len(targets_m)), np.bool_)
    for finder, towers, some in _each_batch(make, groups, every):
        part, gain = _raw_paths(finder, _Ends(targets_m[some], turns[1][some]), some, towers, search)
        gains.append(np.einsum("pab,au,pbv->puv", gain, probe.uav_array.slant_parts, slants[part.tower]))
        pieces.append(part)
    paths = PathSet.one_after_another(pieces) if pieces else PathSet.empty(search.max_depth)
    gain = np.concatenate(gains) if gains else np.zeros((0, 2, 2), dtype=np.complex128)
    if links.excluded is not None:
        counts = ~links.excluded[paths.tower, paths.pose]
        paths, gain = paths.select(counts), gain[counts]
    length = path_lengths(paths, sources_m, targets_m)
    cycles = length / wavelength_m(probe.carrier_hz)
    return Coefficients(paths, gain * np.exp(-2j * np.pi * (cycles - np.round(cycles)))[:, None, None], length)


def _raw_paths(
    finder: _Finder, target: _Ends, poses: IntArray, towers: IntArray, search: Search
) -> tuple[PathSet, ComplexArray]:
    """Return the paths of one batch that consist of reflections only, and their gains (paths, V and H, V and H)."""
    traced = finder.trace(target, search)
    real, imaginary = (np.asarray(part.numpy()) for part in traced.a)
    raw = _arrays(traced, len(poses))
    receiver, tower, path, sequence = _sequences(raw, finder.built.face_of, search.max_depth)
    points = np.full((len(path), search.max_depth, 3), np.nan)
    steps = min(search.max_depth, len(raw["kind"]))
    points[:, :steps] = np.moveaxis(traced.vertices.numpy()[:steps, receiver, tower, path], 0, 1)
    points[sequence < 0] = np.nan
    gain = (real + 1j * imaginary)[receiver, :, tower, :, path].astype(np.complex128)
    return PathSet(poses[receiver], towers[tower], (sequence >= 0).sum(axis=1), sequence, points), gain


def _groups(faces: Faces, sources_m: FloatArray, usable: BoolArray | None) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield (towers, faces) that can share a scene, because the towers have the same ground."""
    if usable is None:
        yield np.arange(len(sources_m)), np.arange(len(faces))
        return
    patterns, which = np.unique(usable, axis=0, return_inverse=True)
    for index, pattern in enumerate(patterns):
        # walls and roofs that are not mirrors still block paths; grounds of other towers are removed
        yield np.flatnonzero(which.reshape(-1) == index), np.flatnonzero(pattern | (faces.solid >= 0))


def _check_gain(raw: dict[str, Any], sources_m: FloatArray, targets_m: FloatArray, carrier_hz: float) -> None:
    """Check that a line of sight has the amplitude of Friis, and that no path gains power."""
    kind, valid = raw["kind"], raw["valid"]
    direct = valid & (kind == 0).all(axis=0)
    receiver, tower, _ = np.nonzero(direct)
    distance = np.linalg.norm(targets_m[receiver] - sources_m[tower], axis=1)
    expected = wavelength_m(carrier_hz) / (4.0 * np.pi * np.maximum(distance, MINIMUM_LENGTH_M))
    # with V/H pairs at both ends, the wave is counted twice: |a|^2 sums to 2 (lambda / 4 pi d)^2
    ratio = raw["gain"][direct] / (np.sqrt(2.0) * expected)
    if len(ratio) and (np.abs(ratio - 1.0) > 1e-2)[distance > 1.0].any():
        raise CheckError("Sionna's line of sight differs from Friis by more than 1 %", cause="a damaged installation")
    if (raw["gain"][valid] > 2.0).any():
        raise CheckError("Sionna reports a path that gains power", cause="a damaged installation")


def _sequences(
    raw: dict[str, Any], face_of: dict[int, IntArray], max_depth: int
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return the indices (receiver, tower, path) in Sionna's arrays, and the faces, of valid pure reflection paths."""
    receiver, tower, path = np.nonzero(raw["valid"])
    sequence = np.full((len(receiver), max_depth), -1, dtype=np.int64)
    good = np.ones(len(receiver), dtype=np.bool_)
    for step in range(min(max_depth, len(raw["kind"]))):
        kind = raw["kind"][step, receiver, tower, path]
        shape = raw["shape"][step, receiver, tower, path]
        primitive = raw["primitive"][step, receiver, tower, path]
        # 0 means no interaction, 1 a specular reflection
        good &= (kind == 0) | (kind == 1)
        for number, owner in face_of.items():
            hit = (kind == 1) & (shape == number)
            sequence[hit, step] = owner[primitive[hit]]
        good &= (kind != 1) | (sequence[:, step] >= 0)
    return receiver[good], tower[good], path[good], sequence[good]


def _refine(
    faces: Faces,
    sources_m: FloatArray,
    targets_m: FloatArray,
    pose: IntArray,
    tower: IntArray,
    sequence: IntArray,
    tolerance_m: float,
    surfaces: Surfaces | None = None,
) -> PathSet:
    """Compute reflection points in float64, and drop paths whose points miss their faces."""
    rows = np.column_stack([pose, tower, sequence])
    # several rays may report the same path with different rounding errors, so remove duplicates
    rows = np.unique(rows, axis=0) if len(rows) else rows
    pose, tower, sequence = rows[:, 0], rows[:, 1], rows[:, 2:]
    depth, sources, targets = (sequence >= 0).sum(axis=1), sources_m[tower], targets_m[pose]
    good = np.linalg.norm(targets - sources, axis=1) >= MINIMUM_LENGTH_M
    if surfaces is None:
        sequence = _relocate(faces, sources, targets, sequence, tolerance_m)
        vertices, fits = retraced(faces, sequence, sources, targets, tolerance_m, _EDGE_TOLERANCE_M)
        good &= fits
    else:
        from .beams import reflection_points

        vertices = np.full((*sequence.shape, 3), np.nan)
        for number in np.unique(depth[depth > 0]):
            some = np.flatnonzero(depth == number)
            sequence[some, :number], vertices[some, :number], fits = reflection_points(
                surfaces, sequence[some, :number], sources[some], targets[some], edge_m=_EDGE_TOLERANCE_M
            )
            good[some] &= fits
    return PathSet(pose[good], tower[good], depth[good], sequence[good], vertices[good])


def _relocate(
    faces: Faces, sources_m: FloatArray, targets_m: FloatArray, sequence: IntArray, tolerance_m: float
) -> IntArray:
    """Replace each face by the coplanar face with the reflection point, because Sionna reports any face in a plane."""
    plane = planes_of(faces)
    if len(np.unique(plane)) == len(plane) or not len(sequence):
        return sequence
    everywhere, result = retraced(faces, sequence, sources_m, targets_m, tolerance_m, np.inf)[0], sequence.copy()
    for step in range(sequence.shape[1]):
        used = np.flatnonzero(sequence[:, step] >= 0)
        # relocate only points that are not in the face that Sionna named
        outside = used[~inside(faces, sequence[used, step], everywhere[used, step], _EDGE_TOLERANCE_M)]
        for row in outside:  # rarely used, only in scenes with disjoint coplanar faces
            twins = np.flatnonzero(plane == plane[sequence[row, step]])
            point = np.tile(everywhere[row, step], (len(twins), 1))
            holding = twins[inside(faces, twins, point, _EDGE_TOLERANCE_M)]
            if len(holding):
                # any of the faces is correct, because merge() keeps only one of several overlapping coplanar faces
                result[row, step] = holding[-1]
    return np.asarray(result)
