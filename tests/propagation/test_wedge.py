"""Diffraction at one wedge: exact half-plane, series of the wedge, continuity, reciprocity, limits."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.special import fresnel, jv

from aerpaw_cmp.common.units import ComplexArray, FloatArray
from aerpaw_cmp.propagation.edges import transition, wedge
from aerpaw_cmp.propagation.field.fresnel import coefficients

WAVELENGTH = 299792458.0 / 3.4e9
K = 2.0 * np.pi / WAVELENGTH
EDGE, ALONG, NORMAL = np.array([0.0, 0, 1]), np.array([1.0, 0, 0]), np.array([0.0, 1, 0])


CONDUCTOR = (0.0, -1e30, np.inf)
CONCRETE = (5.24, -0.3, np.inf)


def matrix(*values: float, face=CONDUCTOR) -> ComplexArray:
    bb, bp, pp = wedge(*(np.array(v) for v in values), face, face)
    return np.array([[bb, bp], [-bp, pp]])


def test_transition_function() -> None:
    """Compute by the Fresnel integrals of the definition, before they cancel."""
    root = np.linspace(1e-3, 4.0, 400)
    sine, cosine = fresnel(root * np.sqrt(2 / np.pi))
    tail = np.sqrt(np.pi / 2) * (0.5 - cosine - 1j * (0.5 - sine))
    assert transition(root) == pytest.approx(2j * np.exp(1j * root**2) * tail, rel=1e-9)


def test_exact_half_plane() -> None:
    text = (Path(__file__).parent / "halfplane_exact.csv").read_text().splitlines()
    rows = list(csv.DictReader(line for line in text if not line.startswith("#")))
    assert len(rows) == 448
    for row in rows:
        r0, r, dz = float(row["r0_m"]), float(row["r_m"]), float(row["dz_m"])
        before = np.radians(float(row["phi0_deg"]))
        after = before + np.pi + np.radians(float(row["shadow_deg"]))
        total = np.hypot(r + r0, dz)
        near, far, sine = total * r0 / (r + r0), total * r / (r + r0), (r + r0) / total
        edge = matrix(before, after, dz / total, 2.0, K * near * far * sine**2 / total)
        sign = -1.0 if row["case"] == "soft" else 1.0
        u = (edge[0, 0] if sign < 0 else edge[1, 1]) / np.sqrt(K) * np.sqrt(near / (far * total)) / near
        u = u * np.exp(-1j * K * total)
        for angle, factor in ((after - before, 1.0), (after + before, sign)):
            if angle < np.pi:
                length = np.sqrt(r**2 + r0**2 - 2 * r * r0 * np.cos(angle) + dz**2)
                u += factor * np.exp(-1j * K * length) / length
        assert 20 * np.log10(abs(u) * total) == pytest.approx(float(row["level_db"]), abs=0.0005)


@pytest.mark.parametrize("exterior", [1.25, 1.5, 1.75, 2.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_series_of_a_wedge(exterior: float, sign: float) -> None:
    """Eigenfunctions of the perfectly conducting wedge under a plane wave."""
    count = 0
    for rho in (3.0, 12.0):
        order = np.arange(int(K * rho * exterior + 80 * exterior))
        weight = (
            np.where(order == 0, 0.5, 1.0) * np.exp(0.5j * order * np.pi / exterior) * jv(order / exterior, K * rho)
        )
        for before in (0.2, 0.9, 2.0):
            for after in np.linspace(0.15, exterior * np.pi - 0.13, 9):
                less, more = after - before, after + before
                exact = (2 / exterior) * np.sum(
                    weight * (np.cos(order * less / exterior) + sign * np.cos(order * more / exterior))
                )
                edge = matrix(before, after, 0.0, exterior, K * rho)
                u = (edge[0, 0] if sign < 0 else edge[1, 1]) / np.sqrt(K * rho) * np.exp(-1j * K * rho)
                for angle, factor in ((less, 1.0), (more, sign), (2 * exterior * np.pi - more, sign)):
                    if abs(angle) < np.pi:
                        u += factor * np.exp(1j * K * rho * np.cos(angle))
                assert abs(u - exact) < 2e-3
                count += 1
    assert count == 54


def diffracted(
    source: FloatArray, target: FloatArray, wave: FloatArray, exterior: float = 1.5, face=CONCRETE
) -> ComplexArray:
    """Field vector at ``target`` of a point source that radiates ``wave`` less its part along the ray."""

    def angle(point: FloatArray) -> float:
        return float(np.mod(np.arctan2(point @ NORMAL, point @ ALONG), 2 * np.pi))

    low, high = np.linalg.norm(source[:2]), np.linalg.norm(target[:2])
    spot = (source[2] + (target[2] - source[2]) * low / (low + high)) * EDGE
    near, far = np.linalg.norm(spot - source), np.linalg.norm(target - spot)
    before, after = (spot - source) / near, (target - spot) / far
    cosine = float(before @ EDGE)
    sine = np.sqrt(1 - cosine**2)
    edge = matrix(
        angle(source - spot), angle(target - spot), cosine, exterior, K * near * far * sine**2 / (near + far), face=face
    )
    into = np.array([[EDGE - cosine * before], [np.cross(EDGE, before)]])[:, 0] / sine
    out = np.array([[EDGE - cosine * after], [np.cross(EDGE, after)]])[:, 0] / sine
    factor = np.exp(-1j * K * (near + far)) / near * np.sqrt(near / (far * (near + far))) / np.sqrt(K)
    return (edge @ (into @ wave)) @ out * factor


def seen(source: FloatArray, target: FloatArray, wave: FloatArray, turn: float) -> ComplexArray:
    """Direct wave and the one off face 0, where they exist, and the edge's."""
    total = diffracted(source, target, wave)
    azimuth = float(np.mod(np.arctan2(target[1], target[0]), 2 * np.pi))
    if azimuth - turn < np.pi:
        way = target - source
        length = np.linalg.norm(way)
        way = way / length
        total = total + (wave - (wave @ way) * way) * np.exp(-1j * K * length) / length
    if azimuth + turn < np.pi:
        mirror = np.array([1.0, -1.0, 1.0])
        way = target - source * mirror
        length = np.linalg.norm(way)
        after = way / length
        before = after * mirror
        across = np.cross(before, NORMAL)
        across /= np.linalg.norm(across)
        field = wave - (wave @ before) * before
        te, tm = coefficients(np.array(abs(before @ NORMAL)), CONCRETE)
        upright = np.cross(across, before)
        reflected = te * (across @ field) * across - tm * (upright @ field) * (upright * mirror)
        total = total + reflected * np.exp(-1j * K * length) / length
    return total


@pytest.mark.parametrize("end", [-1.0, 1.0])
@pytest.mark.parametrize("height", [-24.0, 2.0, 70.0])
def test_field_of_concrete_is_continuous_over_both_boundaries(end: float, height: float) -> None:
    """For any polarisation at oblique incidence, and next to the boundary, where a limit is not needed."""
    turn = 1.0
    source = np.array([30 * np.cos(turn), 30 * np.sin(turn), -25.0])
    boundary = np.pi + end * turn
    sides = [
        seen(source, np.array([40 * np.cos(a), 40 * np.sin(a), height]), np.array([0.3, 0.5, 0.8]), turn)
        for a in (boundary - 1e-7, boundary + 1e-7)
    ]
    assert np.abs(sides[0] - sides[1]).max() < 1e-3 * np.abs(sides[0]).max()


@pytest.mark.parametrize("seed", range(8))
def test_reciprocity(seed: int) -> None:
    draw = np.random.default_rng(seed)
    azimuth = draw.uniform(0.02, 1.5 * np.pi - 0.02, 2)
    first, second = (np.array([20 * np.cos(a), 20 * np.sin(a), draw.uniform(-30, 30)]) for a in azimuth)
    first_field, second_field = draw.normal(size=(2, 3))
    there, back = (
        second_field @ diffracted(first, second, first_field),
        first_field @ diffracted(second, first, second_field),
    )
    assert abs(there - back) < 1e-12 * abs(there)


def test_no_wedge_is_no_edge() -> None:
    """Exterior angle pi: a plane, whose boundaries of shadow and reflection are at its horizon."""
    for before, after in ((0.6, 1.9), (1.2, 1.4), (2.2, 0.4)):
        assert np.abs(matrix(before, after, 0.3, 1.0, 5e4)).max() < 1e-12


def test_on_a_boundary_nothing_is_undefined() -> None:
    for after in (np.pi - 0.7, np.pi + 0.7, 0.7, 0.0, 1.5 * np.pi):
        assert np.isfinite(matrix(0.7, after, 0.0, 1.5, 300.0, face=CONCRETE)).all()
