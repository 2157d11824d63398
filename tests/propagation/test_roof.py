"""Two edges of a roof by an exact field: the boundary integral of a line source at a long box, solved by collocation.

Lengths in wavelengths, time as e^{jwt}. On the surface ``du/dn = j k admittance u``: 0 is hard (H along the edges), inf
soft (E along them). Points inside, where the field must vanish, keep resonances of the inside out (CHIEF).
"""

import numpy as np
import pytest
from scipy.special import hankel2

from aerpaw_cmp.common.units import ComplexArray, FloatArray
from aerpaw_cmp.propagation.field.edges import over_two
from aerpaw_cmp.propagation.field.wedge import wedge

CONDUCTOR = (0.0, -1e30, np.inf)
CONCRETE = (5.24, -0.3, np.inf)

K = 2.0 * np.pi
NODES, WEIGHTS = np.polynomial.legendre.leggauss(4)


def green(points: FloatArray, others: FloatArray) -> ComplexArray:
    """Field (points, others) of line sources."""
    return np.asarray(hankel2(0, K * np.linalg.norm(points[:, None] - others, axis=2)) / 4j)


def behind_box(
    size: tuple[float, float], source: FloatArray, targets: FloatArray, admittance: complex, per_wave: int = 8
) -> ComplexArray:
    """Total field (targets,) of a line source at a box from (0, -height) to (width, 0), over that in free space.

    Free space is taken over the way round both upper corners.

    Parameters
    ----------
    size : (width, height)
    source : (2,)
    targets : (targets, 2)
    admittance : complex
        Of the surface; infinite where the field vanishes.
    per_wave : int
        Pieces of the surface per wavelength, finer towards corners.

    Returns
    -------
    (targets,) complex
    """
    width, height = size
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, -height], [0.0, -height]])
    start, end, out = [], [], []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = int(np.ceil(per_wave * np.linalg.norm(b - a)))
        share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, count + 1))
        share = 0.5 * (share + np.linspace(0.0, 1.0, count + 1))
        knots = a + share[:, None] * (b - a)
        start.append(knots[:-1])
        end.append(knots[1:])
        way = (b - a) / np.linalg.norm(b - a)
        out.append(np.tile([-way[1], way[0]], (count, 1)))
    first, last, normal = np.vstack(start), np.vstack(end), np.vstack(out)
    middle, half = 0.5 * (first + last), 0.5 * (last - first)
    length = 2.0 * np.linalg.norm(half, axis=1)

    def layers(points: FloatArray, own: bool) -> tuple[ComplexArray, ComplexArray]:
        """Integrals (points, pieces) of the line source and of its normal derivative."""
        single, double = (np.zeros((len(points), len(middle)), np.complex128) for _ in range(2))
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            off = points[:, None] - (middle + node * half)
            far = np.linalg.norm(off, axis=2)
            part = 0.5 * weight * length
            single += part * hankel2(0, K * far) / 4j
            double += part * K * hankel2(1, K * far) / 4j * (off * normal).sum(axis=2) / far
        if own:
            log = np.log(np.exp(np.euler_gamma) * K * length / 4.0) - 1.0
            np.fill_diagonal(single, length / 4j * (1.0 - 2j / np.pi * log))
            np.fill_diagonal(double, 0.0)
        return single, double

    inner = np.random.default_rng(0).uniform([0.05, 0.05], [0.95, 0.95], (40, 2)) * [width, -height]
    points = np.vstack([middle, inner])
    single, double = layers(points, own=False)
    single[: len(middle)], double[: len(middle)] = layers(middle, own=True)
    given = green(points, source[None])[:, 0]
    there_single, there_double = layers(targets, own=False)
    if np.isinf(admittance):
        slope = np.linalg.lstsq(single, given, rcond=None)[0]
        scattered = -there_single @ slope
    else:
        system = 1j * K * admittance * single - double
        system[: len(middle)] += 0.5 * np.eye(len(middle))
        value = np.linalg.lstsq(system, given, rcond=None)[0]
        scattered = (there_double - 1j * K * admittance * there_single) @ value
    total = green(targets, source[None])[:, 0] + scattered
    way = np.linalg.norm(source) + width + np.linalg.norm(targets - [width, 0.0], axis=1)
    return np.asarray(total / (hankel2(0, K * way) / 4j))


def over_roof(width: float, source: FloatArray, target: FloatArray, face: tuple[float, float, float]) -> ComplexArray:
    """Field (soft, hard) over a roof of a width from (0, 0) on, lengths in wavelengths, over that in free space."""
    wall, west, east = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    corner, other, exterior = np.zeros(3), np.array([width, 0.0, 0.0]), np.float64(1.5)
    here, there = (np.append(end, 0.0) for end in (source, target))
    edges = (
        (corner, (0.0, 0.0, -1.0), wall, east, west, exterior, face, face),
        (other, (0.0, 0.0, 1.0), wall, west, east, exterior, face, face),
    )
    joined = over_two(here, there, *edges, corner, other, (1.0, 1.0), K)[3]
    last = np.linalg.norm(there - other)
    total = np.linalg.norm(here) + width + last
    # the bases of both edges differ by a sign
    field = -np.array([joined[0], joined[3]]) * 2.0 * K * np.sqrt(total)
    if target[1] > 0.0:  # the first edge alone is seen, too
        near, far = np.linalg.norm(here), np.linalg.norm(there)
        before, after = (np.mod(np.arctan2(-x, -y), 2 * np.pi) for x, y in (source, target))
        angles = (np.array(value) for value in (before, after, 0.0, 1.5, K * near * far / (near + far)))
        soft, _, hard = wedge(*angles, face, face)
        phase = np.exp(-1j * K * (near + far - total))
        field = field + np.array([soft, hard]) * np.sqrt(total / (K * near * far)) * phase
    return field


@pytest.mark.parametrize(("face", "most_db"), [(CONCRETE, (0.8, 0.9)), (CONDUCTOR, (0.5, 0.7))])
def test_two_edges_of_a_roof_by_the_boundary_integral(
    face: tuple[float, float, float], most_db: tuple[float, float]
) -> None:
    """10 wavelengths wide, from the deep shadow through the plane of the roof; soft and hard; the last is one edge."""
    source, heights = np.array([-30.0, -3.0]), np.array([-4.0, -2.0, -1.0, -0.01, 0.01, 1.0, 3.0])
    targets = np.column_stack([np.full(len(heights), 40.0), heights])
    ours = np.array([over_roof(10.0, source, target, face) for target in targets])
    root = np.sqrt(complex(face[0], face[1]) - 1.0)
    admittances = (np.inf, 0.0) if face is CONDUCTOR else (root, root / complex(face[0], face[1]))
    for pole, admittance in enumerate(admittances):
        exact = behind_box((10.0, 28.0), source, targets, admittance)
        off = 20 * np.log10(np.abs(ours[:, pole] / exact))
        assert np.abs(off).max() < most_db[pole], off
        assert abs(off[-1]) < 0.25, off
        assert abs(off[4] - off[3]) < 0.05, "no step in the plane of the roof"
