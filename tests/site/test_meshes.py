"""Check closed bodies by the divergence theorem, and scenes by opening them in Sionna."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from shapely.geometry import Polygon, box

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.site_scene import export_scene
from aerpaw_cmp.site.scenes import WALL_DEPTH_M, building_mesh, site_meshes
from aerpaw_cmp.site.site import Building
from aerpaw_cmp.site.siteyaml import load_site

SHAPES = [
    box(0, 0, 20, 10),
    Polygon([(0, 0), (0, 10), (10, 0)]),  # clockwise
    Polygon([(0, 0), (30, 0), (30, 30), (0, 30)], [[(10, 10), (20, 10), (20, 20), (10, 20)]]),
    Polygon([(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)]),
]


def normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


@pytest.mark.parametrize("shape", SHAPES)
def test_walls_and_roof_enclose_the_building(shape: Polygon) -> None:
    vertices, triangles = building_mesh(Building("b", shape, 8.0, base_m=2.0))
    area = normals(vertices, triangles)
    wall = area[:, 2] == 0
    assert abs(area[wall]).sum() > 0
    lengths = np.linalg.norm(area, axis=1)
    assert lengths[wall].sum() == pytest.approx(shape.length * (8 + WALL_DEPTH_M))
    assert area[~wall, 2].sum() == pytest.approx(shape.area)  # roof only, upwards: no bottom
    assert (area[~wall, 2] > 0).all()
    assert vertices[:, 2].min() == 2 - WALL_DEPTH_M < 1.8, "walls begin below the ground"
    # volume above the walls' foot, from x n_x alone: right only if every wall faces outwards, holes too
    centre = vertices[triangles].mean(axis=1)
    assert (centre[:, 0] * area[:, 0]).sum() == pytest.approx(shape.area * (8 + WALL_DEPTH_M))
    assert (centre[:, 1] * area[:, 1]).sum() == pytest.approx(shape.area * (8 + WALL_DEPTH_M))


def test_one_mesh_per_material() -> None:
    site = load_site("lake_wheeler")
    meshes = site_meshes(site)
    assert set(meshes) == {"medium_dry_ground", "concrete"}
    vertices, triangles = meshes["concrete"]
    count = 0
    for building in site.buildings:
        own = building_mesh(building)
        rows = triangles[count : count + len(own[1])]
        np.testing.assert_array_equal(vertices[rows], own[0][own[1]])
        count += len(rows)
    assert count == len(triangles)
    assert (normals(*meshes["medium_dry_ground"])[:, 2] > 0).all()


def test_export_is_well_formed(tmp_path: Path) -> None:
    path, *parts = export_scene(load_site("lake_wheeler"), tmp_path / "scene")
    assert {part.stem for part in parts} == {"all_medium_dry_ground", "all_concrete"}
    root = ElementTree.parse(path).getroot()
    ids = {bsdf.get("id") for bsdf in root.iter("bsdf")}
    assert {ref.get("id") for ref in root.iter("ref")} == ids
    for shape in root.iter("shape"):
        name = shape.find("string").get("value")  # type: ignore[union-attr]
        content = (path.parent / str(name)).read_bytes()
        head, _, body = content.partition(b"end_header\n")
        vertices, faces = (int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element"))
        assert len(body) == 12 * vertices + 13 * faces
    assert "(c) OpenStreetMap contributors, ODbL" in path.read_text()
    with pytest.raises(UsageError, match="cannot be written"):
        export_scene(load_site("lake_wheeler"), path)  # a file is in the way


@pytest.mark.sionna
def test_sionna_opens_the_scene(tmp_path: Path) -> None:
    path = export_scene(load_site("lake_wheeler"), tmp_path)[0]
    script = (
        "from aerpaw_cmp.propagation.llvm import let_sionna_load; let_sionna_load()\n"
        "import sys, mitsuba as mi; mi.set_variant('llvm_ad_mono_polarized')\n"
        "from sionna.rt import load_scene\n"
        "scene = load_scene(sys.argv[1]); scene.frequency = 3.4e9\n"
        "materials = scene.radio_materials\n"
        "box = scene.mi_scene.bbox()\n"
        "print('materials', sorted(materials), len(scene.objects))\n"
        "print('up', round(box.max.z, 3), float(materials['itu_concrete'].thickness[0]))\n"
    )
    # a child process: an unsuitable LLVM aborts the process it is loaded into
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "itu_medium_dry_ground" in done.stdout
    assert "up 6.8 0.3" in done.stdout.replace("0.30000001192092896", "0.3")
