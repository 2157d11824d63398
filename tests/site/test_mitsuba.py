"""Mitsuba scenes: every way to write one, and one message for every way to write it wrong."""

import numpy as np
import pytest

from aerpaw_cmp.common.errors import AerpawCmpError, InputError, UsageError
from aerpaw_cmp.site.materials import material
from aerpaw_cmp.site.mitsuba import read_ply, read_scene
from aerpaw_cmp.site.scenes import ground_share, placed_scene, with_ground
from tests.scene_files import PLY_HEAD, box, ply

ITU = '<bsdf type="itu-radio-material" id="m"><string name="type" value="concrete"/></bsdf>'
REF = '<ref id="m" name="bsdf"/>'
SQUARE = '<shape type="ply" id="s"><string name="filename" value="square.ply"/>{}</shape>'
POINTS = ((0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0))
FACES = ((0, 1, 2), (0, 2, 3))


def write(folder, body, bsdf=ITU):
    path = folder / "scene.xml"
    (folder / "square.ply").write_bytes(ply(POINTS, FACES))
    path.write_text(f'<scene version="2.1.0">{bsdf}{body}</scene>')
    return path


def test_a_ply_has_its_points_and_triangles():
    vertices, triangles = read_ply(ply(POINTS, FACES))
    assert vertices.tolist() == [list(map(float, point)) for point in POINTS]
    assert triangles.tolist() == [list(face) for face in FACES]
    assert [part.shape for part in read_ply(ply(POINTS, ()))] == [(4, 3), (0, 3)]


def test_a_ply_cut_off_anywhere_is_one_message():
    data = ply(POINTS, FACES)
    for length in range(len(data)):
        with pytest.raises(InputError):
            read_ply(data[:length])


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (b"binary_little_endian", b"ascii", "a PLY of format 'ascii'; expected a binary PLY of triangles"),
        (b"binary_little", b"binary_big", "a PLY of format 'binary_big_endian'"),
        (b"property double z", b"property double w", "no x, y and z"),
        (b"property double z", b"property list uchar double z", "ends before"),
        (b"vertex_index", b"vertex_names", "its faces list no vertices"),
        (b"uint vertex_index", b"float vertex_index", "its faces list no vertices"),
        (b"element vertex 4", b"element vertex -4", "ends before"),
        (b"property float s", b"property half s", "the header has 'property half s'"),
        (b"\x03", b"\x04", "a face is not a triangle"),
    ],
)
def test_other_meshes_are_refused(before, after, message):
    with pytest.raises(InputError, match=message):
        read_ply(ply(POINTS, FACES).replace(before, after))


def test_closed_boxes_look_outward_and_other_shapes_are_told(tmp_path):
    body = box(tmp_path, "b", "m", (1, 2, 0), (3, 5, 4)) + '<shape type="sphere"/>'
    scene = read_scene(write(tmp_path, body))
    corners = scene.vertices_m[scene.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert 0.5 * np.linalg.norm(outward, axis=1).sum() == pytest.approx(2 * (6 + 8 + 12))
    assert (np.einsum("ti,ti->t", outward, corners.mean(axis=1) - [2, 3.5, 2]) > 0).all()
    assert scene.notes == ("warning: 1 shape of type 'sphere' left out: only ply is read",)


@pytest.mark.parametrize(
    ("bsdf", "permittivity", "thickness"),
    [
        (ITU, 5.24, 0.1),
        (ITU.replace("</bsdf>", '<float name="thickness" value="0.3"/></bsdf>'), 5.24, 0.3),
        (
            '<bsdf type="diffuse" id="m"/><bsdf type="diffuse" id="mat-itu_brick"/>'.replace(
                'id="m"', 'id="mat-itu_wood"'
            ),
            1.99,
            0.1,
        ),
        (
            '<bsdf type="radio-material" id="m"><float name="relative_permittivity" value="3.5"/><float name="conductivity" value="0.1"/></bsdf>',
            3.5,
            0.1,
        ),
        ('<bsdf type="absorber-radio-material" id="m"/>', 1.0, None),
    ],
)
def test_radio_materials(bsdf, permittivity, thickness, tmp_path):
    name = "mat-itu_wood" if "mat-itu_wood" in bsdf else "m"
    scene = read_scene(write(tmp_path, SQUARE.format(f'<ref id="{name}" name="bsdf"/>'), bsdf))
    what = material(scene.materials[0])
    assert what.relative_permittivity(3.4e9).real == pytest.approx(permittivity)
    assert what.thickness_m == thickness
    assert material(what.name) == what


def test_a_material_inside_a_shape_and_one_named_by_hand(tmp_path):
    assert read_scene(write(tmp_path, SQUARE.format(ITU), "")).materials == ("concrete with thickness=0.1",)
    path = write(tmp_path, SQUARE.format(REF), '<bsdf type="principled" id="m"/>')
    with pytest.raises(UsageError, match=r"'m' is of type 'principled'.*--material 'm=concrete'"):
        read_scene(path)
    assert read_scene(path, {"m": "brick"}).materials == ("brick",)
    with pytest.raises(UsageError, match="no material 'wall'; expected one of m"):
        read_scene(path, {"wall": "brick", "m": "brick"})


MESH = '<shape type="ply" id="s"><string name="filename" value="{}"/>' + REF + "</shape>"


@pytest.mark.parametrize(
    ("body", "bsdf", "message"),
    [
        (MESH.format("gone.ply"), ITU, "names 'gone.ply', which is not there"),
        (MESH.format("../a.ply"), ITU, "leaves its folder|no file of its folder"),
        (MESH.format("/etc/hostname"), ITU, "leaves its folder|no file of its folder"),
        (MESH.format("C:/a.ply"), ITU, "leaves its folder|no file of its folder"),
        (MESH.format("..\\a.ply"), ITU, "leaves its folder|no file of its folder"),
        (MESH.format("link.ply"), ITU, "leaves its folder|no file of its folder"),
        (MESH.format("huge.ply"), ITU, "ends before the 4000000000 entries of 'vertex'"),
        (MESH.format("long.ply"), ITU, "no 'end_header' in its first 65536 bytes"),
        (MESH.format("nan.ply"), ITU, "a vertex is not a finite number"),
        (MESH.format("index.ply"), ITU, "a face names vertex 9"),
        (MESH.format("text.ply"), ITU, "does not begin with 'ply'"),
        ('<shape type="ply" id="s">' + REF + "</shape>", ITU, "the shape 's' names no file"),
        (SQUARE.format(""), ITU, "the shape 's' has no material"),
        (SQUARE.format('<ref id="other"/>'), ITU, "names the material 'other', which is not in the scene"),
        (SQUARE.format(REF), ITU.replace("concrete", "cheese"), "unknown material 'cheese'"),
        (SQUARE.format(REF + '<transform name="to_world"><scale value="2"/></transform>'), ITU, "moved by a to_world"),
        (SQUARE.format(REF), ITU.replace("</bsdf>", '<float name="thickness" value="a"/></bsdf>'), "'a'; expected a finite"),
        ('<include filename="/etc/passwd"/>', ITU, "includes another XML file"),
        ("", ITU, "no triangle"),
        ("<shape", ITU, "not XML"),
    ],
)  # fmt: skip
def test_bad_scenes_are_one_message(body, bsdf, message, tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "a.ply").write_bytes(ply(POINTS, FACES))
    (folder / "link.ply").symlink_to(tmp_path / "a.ply")
    (folder / "huge.ply").write_text(PLY_HEAD.format(4_000_000_000, 2))
    (folder / "long.ply").write_text("ply\n" + "comment x\n" * 10_000 + "end_header\n")
    (folder / "nan.ply").write_bytes(ply((*POINTS[:2], (2, np.nan, 0), POINTS[3]), FACES))
    (folder / "index.ply").write_bytes(ply(POINTS, ((0, 1, 9), (0, 2, 3))))
    (folder / "text.ply").write_text("solid\n")
    with pytest.raises(AerpawCmpError, match=message) as refused:
        read_scene(write(folder, body, bsdf))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_refused(encoding, tmp_path):
    bomb = (
        '<?xml version="1.0"?><!DOCTYPE s [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><scene version="2.1.0">&b;</scene>'
    )
    path = tmp_path / "scene.xml"
    path.write_bytes(bomb.encode(encoding))
    with pytest.raises(InputError, match="declares entities"):
        read_scene(path)


def test_ground_is_looked_for_and_added(tmp_path):
    small, flat = box(tmp_path, "a", "m", (-1, -1, -1), (1, 1, 1)), box(tmp_path, "b", "m", (-20, -20, 0), (20, 20, 0))
    assert ground_share(read_scene(write(tmp_path, small + flat))) == 1.0
    upright = box(tmp_path, "c", "m", (-1, 0, -1), (1, 1e-3, 1))
    scene = read_scene(write(tmp_path, upright + box(tmp_path, "d", "m", (-0.2,) * 3, (0.2,) * 3)))
    assert ground_share(scene) < 0.5
    grounded = with_ground(scene, "wet_ground")
    assert ground_share(grounded) == 1.0
    assert grounded.materials[-1] == "wet_ground"
    assert grounded.vertices_m[:, 2].min() == scene.vertices_m[:, 2].min()


def test_a_scene_is_turned_moved_and_recognised(tmp_path):
    path = write(tmp_path, SQUARE.format(REF))
    plain = read_scene(path)
    moved = placed_scene(path, offset_m=(10.0, 0.0, 1.0), turn_deg=90.0, sha256=plain.sha256)
    assert moved.vertices_m[1] == pytest.approx([10.0, 2.0, 1.0])  # (2, 0, 0) turned by a quarter
    path.write_text(path.read_text().replace("concrete", "brick"))
    with pytest.raises(UsageError, match="they changed since the site was made"):
        placed_scene(path, sha256=plain.sha256)
