"""A rough ground in the replay of a flight: the closed form, its limits, and the same by the second implementation."""

import dataclasses

import numpy as np
import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.flight.gains import path_loss, path_losses
from aerpaw_cmp.flight.replay import replay_poses
from aerpaw_cmp.flight.settings import RtSettings, load_flight
from aerpaw_cmp.jobs.flight_run import Model, recommended_changes
from aerpaw_cmp.propagation.check import reference
from aerpaw_cmp.propagation.check.audit import Expected
from aerpaw_cmp.propagation.geometry import Link, Poses, single_element
from aerpaw_cmp.site.materials import material
from aerpaw_cmp.site.siteyaml import load_site

SITE = load_site("lake_wheeler")
BARE = dataclasses.replace(SITE, buildings=())
LINK = Link(3.4e9, {"LW1": single_element()}, single_element())
N = 60
LW1 = SITE.towers["LW1"].position_m
POSES = Poses(
    LW1 * [1, 1, 0] + np.stack([np.linspace(20, 500, N), np.linspace(-30, 80, N), np.linspace(5, 70, N)], axis=1),
    np.broadcast_to(np.eye(3), (N, 3, 3)),
)


def rt(**more: object) -> RtSettings:
    return RtSettings.model_validate({"max_depth": 1, "audit_links": 0, **more})


@pytest.mark.parametrize("sigma", [0.0, 0.02, 0.1, 1.0, 9.0])
def test_the_replay_is_the_two_ray_form_of_that_roughness(sigma):
    replayed = replay_poses(BARE, rt(ground_roughness_m=sigma), LINK, POSES)
    k = 2 * np.pi * 3.4e9 / 299792458.0
    across, rise, total = (np.linalg.norm((POSES.position_m - LW1)[:, :2], axis=1), POSES.position_m[:, 2] - LW1[2],
                           POSES.position_m[:, 2] + LW1[2])  # fmt: skip
    direct, bounced = np.hypot(across, rise), np.hypot(across, total)
    sine = total / bounced
    eta = complex(material("medium_dry_ground").relative_permittivity(3.4e9))
    root = np.sqrt(eta - (1 - sine**2))
    gamma = (eta * sine - root) / (eta * sine + root) * np.exp(-2 * (k * sigma * sine) ** 2)
    field = (np.exp(-1j * k * direct) / direct + gamma * np.exp(-1j * k * bounced) / bounced) / (2 * k)
    np.testing.assert_allclose(replayed.rss_dbm[:, 0], 40 + 20 * np.log10(np.abs(field)), atol=1e-6)
    assert replayed.has_path.all()


def test_roofs_and_walls_stay_smooth_and_the_second_implementation_agrees():
    settings = rt(ground_roughness_m=0.05, max_depth=2)
    few = Poses(POSES.position_m[::2], POSES.rotation[::2])  # buildings near LW1 hide many ground reflections
    replayed = replay_poses(SITE, settings, LINK, few)
    rough = path_losses(SITE, settings, LINK.carrier_hz)["rough ground"]
    assert rough is not None
    loss = rough(replayed.paths, LW1[None], few.position_m)
    ground = (replayed.faces.solid[replayed.paths.faces] < 0) & (replayed.paths.faces >= 0)
    np.testing.assert_array_equal(loss > 0, ground.any(axis=1))
    expected = Expected.of(LINK, reference.ExpectedLoss(ground_roughness_m=0.05))
    second = reference.Reference(SITE, "LW1", expected.link, expected.loss)
    off_ground = np.flatnonzero(ground.any(axis=1) & (replayed.paths.depth == 1))
    assert len(off_ground) > 5
    assert not ground.any(axis=1).all(), "roofs and walls reflect, too"
    for row in off_ground:
        target = tuple(few.position_m[replayed.paths.pose[row]].tolist())
        mirrors = [m for m in second.mirrors if m.solid < 0]
        assert second.loss_db(mirrors[:1], target) == pytest.approx(loss[row], rel=1e-9)


def test_a_ground_that_is_not_known_is_refused():
    scene = dataclasses.replace(BARE, scene=object())
    with pytest.raises(UsageError, match="scene of triangles"):
        path_loss(scene, rt(ground_roughness_m=0.1), 3.4e9)
    assert path_loss(scene, rt(), 3.4e9) is None


def test_the_ladder_writes_and_takes_away_the_roughness(tmp_path):
    path = tmp_path / "flight.yaml"
    for roughness, model in ((0.0, Model(ground="rough", roughness_m=0.05)), (0.05, Model(ground="coherent"))):
        path.write_text(
            f"flight: planted\nlogs: [{{path: a}}]\nrt: {{max_depth: 1, ground_roughness_m: {roughness}}}\n"
        )
        settings = load_flight(path)
        changes = recommended_changes(settings, {"rt": {"ground_roughness_m": roughness}}, model)
        assert changes["rt", "ground_roughness_m"] == (model.roughness_m or None)
