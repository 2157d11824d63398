"""A scene to a site.yaml, through replay, and back."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="numba is not installed (extra 'fast')")

from aerpaw_cmp.__main__ import main
from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.jobs.site_scene import SceneOptions, is_scene, run_scene_import, run_site_export
from aerpaw_cmp.propagation.field.foliage import stand_depth_m
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
from aerpaw_cmp.propagation.replay import replay
from aerpaw_cmp.site.mitsuba import TriangleScene
from aerpaw_cmp.site.scenes import usable_scene
from aerpaw_cmp.site.siteyaml import load_site
from tests.scene_files import box
from tests.simulated import planned, simulate, write_yaml

ROOM = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="stone"><string name="type" value="marble"/><float name="thickness" value="0.2"/></bsdf>
<bsdf type="radio-material" id="mine"><float name="relative_permittivity" value="4"/><float name="conductivity" value="0.01"/></bsdf>
{}
</scene>"""


@pytest.fixture
def room(tmp_path: Path) -> Path:
    folder = tmp_path / "room"
    folder.mkdir()
    floor = box(folder, "floor", "stone", (-50, -50, 0), (50, 50, 0))
    (folder / "room.xml").write_text(ROOM.format(floor + box(folder, "block", "mine", (15, -5, 0), (25, 5, 10))))
    return folder / "room.xml"


def paths_of(site_file: Path):
    site = load_site(site_file)
    link = Link(3.4e9, dict.fromkeys(site.towers, single_element()), single_element())
    spots = np.random.default_rng(1).uniform([-30, -30, 1], [12, 30, 20], (20, 3))
    return replay(site, link, Poses(spots, np.tile(np.eye(3), (20, 1, 1))))


def test_in_and_out_and_in_again(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "site.yaml"
    arguments = ["site", "import", room, "--origin", "35.7,-78.7,90", "--tower", "T=-5,3,10", "-o", out]
    assert main([str(a) for a in arguments]) == 0
    site = load_site(out)
    assert site.towers["T"].position_m == pytest.approx([-5, 3, 10], abs=1e-4)
    first = paths_of(out)
    assert {"marble with thickness=0.2", "constant with permittivity=4 conductivity=0.01 thickness=0.1"} == set(
        first.faces.material
    )
    assert main(["site", "export", str(out), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.rstrip().endswith(str(tmp_path / "out" / "scene.xml"))
    again = tmp_path / "again.yaml"
    run_scene_import(tmp_path / "out" / "scene.xml", again, SceneOptions(origin="35.7,-78.7", towers=["T=-5,3,10"]))
    second = paths_of(again)
    assert second.faces.material == first.faces.material
    assert np.array_equal(second.paths.faces, first.paths.faces)
    assert np.nanmax(np.abs(second.rss_dbm - first.rss_dbm)) < 1e-6


def test_what_a_scene_does_not_say_is_asked_for(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.yaml"
    with pytest.raises(UsageError, match="does not contain its position on Earth"):
        run_scene_import(room, out, SceneOptions())
    with pytest.raises(UsageError, match=r"has no towers.*from -50 to 50 m east"):
        run_scene_import(room, out, SceneOptions(origin="local"))
    with pytest.raises(UsageError, match="longitude before latitude"):
        run_scene_import(room, out, SceneOptions(origin="-118.7,35.7"))
    with pytest.raises(UsageError, match="--tower A"):
        run_scene_import(room, out, SceneOptions(origin="local", towers=["A=1,2"]))
    with pytest.raises(UsageError, match="two towers named 'A'"):
        run_scene_import(room, out, SceneOptions(origin="local", towers=["A=1,2,3", "A=4,5,6"]))
    assert not out.exists()
    messages = run_scene_import(room, out, SceneOptions(origin="local", towers=["A=1,2,3"]))
    assert any("no georeference" in line for line in messages)


def test_towers_of_a_base_site_are_kept(room: Path, tmp_path: Path) -> None:
    run_scene_import(room, tmp_path / "s.yaml", SceneOptions(base="lake_wheeler"))
    site, base = load_site(tmp_path / "s.yaml"), load_site("lake_wheeler")
    assert set(site.towers) == set(base.towers)
    assert site.scene is not None
    assert not site.buildings


def test_a_scene_that_changed_or_went_is_said(room: Path, tmp_path: Path) -> None:
    out = tmp_path / "site.yaml"
    run_scene_import(room, out, SceneOptions(origin="local", towers=["A=1,2,3"]))
    room.write_text(room.read_text().replace("marble", "brick"))
    with pytest.raises(UsageError, match="they changed since the site was made") as refused:
        load_site(out)
    assert refused.value.exit_code == 2
    room.unlink()
    assert main(["site", "show", str(out), "-o", str(tmp_path / "show")]) == 3


def test_maps_are_no_scenes(room: Path, tmp_path: Path) -> None:
    (tmp_path / "map.xml").write_text("<osm><way/></osm>")
    assert is_scene(room)
    assert not is_scene(tmp_path / "map.xml")
    assert not is_scene(tmp_path / "none.xml")


def test_a_site_of_prisms_can_be_written(tmp_path: Path) -> None:
    files = run_site_export("lake_wheeler", tmp_path / "out").files
    assert files[0].name == "scene.xml"
    assert {f.stem for f in files[1:]} >= {"all_concrete", "all_medium_dry_ground"}


SINGLE = {"layout": "single"}
FLIGHT = planned(
    "room", [(-18, 8.0, 12), (6, 8.0, 6)], {"T": {"USRP1": 12.3}}, plan={"speed_mps": 4.0, "rss_interval_s": 0.1},
    site={"file": "site.yaml"}, timezone="UTC", link={"rss": {"carrier_hz": 3.3e9, "tower": SINGLE, "uav": SINGLE}},
    rt={"audit_links": 3, "advanced": {"samples": 10_000}},
)  # fmt: skip


@pytest.fixture
def flown(room: Path, tmp_path: Path) -> Path:
    run_scene_import(room, tmp_path / "site.yaml", SceneOptions(origin="35.7,-78.7", towers=["T=-5,3,10"]))
    simulate(write_yaml(tmp_path / "flight.yaml", FLIGHT))
    return tmp_path / "flight.yaml"


@pytest.mark.sionna
@pytest.mark.usefixtures("sionna")
def test_a_report_of_a_scene_is_audited_and_its_paths_explained(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Sionna gets the same triangles: no path is missing or too many, and the fields are its own."""
    out = tmp_path / "out"
    assert main(["report", str(flown), "-o", str(out), "--figures", "none", "--strict", "--quiet"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())["rt"]
    audit = metrics["audit"]
    assert (audit["reference"], audit["missing_paths"], audit["extra_paths"]) == ("sionna", 0, 0)
    assert audit["links"] == 3
    assert audit["field"]["paths"] > 3
    assert audit["field"]["power_max_db"] < 0.1
    assert "the second implementation, which supports only prisms, not triangles" in audit["field"]["not_covered"]
    capsys.readouterr()
    assert main(["explain", str(flown), "--time", "4", "--tower", "T", "--json", "--quiet"]) == 0
    explained = json.loads(capsys.readouterr().out)
    assert explained["paths"][0]["path"] == "line of sight"
    assert len(explained["paths"]) > 1


@pytest.mark.parametrize("option", ["--origin 1,2", "--material a=concrete", "--turn 5", "--untagged forest"])
def test_an_option_of_the_other_kind_is_refused(
    option: str, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They were ignored: a site whose tower or origin was not the one that was asked for."""
    file = room if option.startswith("--untagged") else tmp_path / "farm.geojson"
    arguments = ["site", "import", str(file), *option.split(), "-o", str(tmp_path / "site.yaml")]
    assert main(arguments) == 2
    assert f"{option.split()[0]} with " in capsys.readouterr().err
    assert not (tmp_path / "site.yaml").exists()


TWIN = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="mat-metal"><string name="type" value="metal"/></bsdf>
<bsdf type="radio-material" id="mat-ground"><float name="relative_permittivity" value="3"/><float name="conductivity" value="0.005"/><float name="thickness" value="1"/></bsdf>
<bsdf type="radio-material" id="mat-tree_canopy"><float name="relative_permittivity" value="1.2"/><float name="scattering_coefficient" value="0.4"/></bsdf>
{}
</scene>"""
TWINS = (
    ("Terrain", "mat-ground", (-200, -200, 0), (200, 200, 0)), ("mast", "mat-metal", (-0.4, -0.4, 0), (0.4, 0.4, 12)),
    ("sector", "mat-metal", (0.5, -0.1, 9.3), (0.7, 0.1, 10.7)), ("street", "mat-metal", (-45, -5, 0), (-35, 5, 8)),
    ("a_canopy", "mat-tree_canopy", (47, -9, 6), (53, 9, 14)),
    ("tree_1__trunk", "mat-ground", (49.8, -0.2, 0), (50.2, 0.2, 6)),
)  # fmt: skip


def test_masts_hide_nothing_and_meshes_of_trees_are_media(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An antenna inside its mast and next to its sector panel is not blocked. A canopy attenuates by its chord."""
    (tmp_path / "twin.xml").write_text(TWIN.format("".join(box(tmp_path, *mesh) for mesh in TWINS)))
    out = tmp_path / "site.yaml"
    arguments = ["site", "import", str(tmp_path / "twin.xml"), "--origin", "35.7,-78.7", "--tower", "T=0,0,10"]
    assert main([*arguments, "-o", str(out)]) == 0
    first = capsys.readouterr().err.splitlines()[:3]
    assert first[0] == "the antenna of T is inside mesh mast, which therefore does not block or reflect"
    assert first[1] == "the antenna of T is at mesh sector, which therefore does not block or reflect"
    assert first[2].startswith("vegetation is a medium, not a mirror: 1 mesh; 1 mesh of trunks")
    site = load_site(out)
    assert all(text in site.notes for text in first)
    assert site.scene is not None
    assert {site.scene.shapes[shape] for shape in site.scene.shape} == {"Terrain", "street"}
    [canopy] = site.forests
    assert (canopy.base_m, canopy.height_m, canopy.filled) == pytest.approx((6.0, 8.0, 1.0))
    angles = np.radians(np.arange(0, 360, 15))
    spots = np.column_stack([120 * np.cos(angles), 120 * np.sin(angles), np.full(len(angles), 10.0)])
    link = Link(3.4e9, {"T": single_element()}, single_element())
    poses = Poses(spots, np.tile(np.eye(3), (len(spots), 1, 1)))
    clear = replay(site, link, poses).rss_dbm[:, 0]
    assert np.isfinite(clear).all()
    depth = stand_depth_m(site, np.tile([0.0, 0.0, 10.0], (len(spots), 1)), spots)
    np.testing.assert_allclose(depth[0], 6.0)  # 3 + 3 m of wood, at any slope
    np.testing.assert_allclose(depth[1:-1], 0.0)


def test_a_mesh_is_as_full_as_its_volume_and_its_parts_stand_apart() -> None:
    """Two pyramids in one mesh are two media, each a third of its prism. A hill is not an enclosing mesh."""
    corners = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0], [0, 0, 9.0]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    hill = np.array([[-90, -90, 0], [90, -90, 0], [90, 90, 0], [-90, 90, 0], [0, 0, 9.0]])
    scene = TriangleScene(
        vertices_m=np.concatenate([corners, corners + np.array([50, 0, -2]), hill]),
        triangles=np.concatenate([faces, faces + 5, faces[2:] + 10]),
        shape=np.repeat([0, 1], [12, 4]),
        shapes=("crowns", "hill"),
        materials=("vegetation", "concrete"),
    )
    without, woods, notes = usable_scene(scene, {"T": np.array([0.0, 0.0, 5.0])})
    assert [wood.filled for wood in woods] == pytest.approx([1 / 3, 1 / 3])
    assert [wood.base_m for wood in woods] == pytest.approx([0.0, -2.0])
    assert set(without.shape.tolist()) == {1}
    assert not any("antenna" in note for note in notes if "hill" in note)
