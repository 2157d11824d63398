import math

import pytest

from aerpaw_cmp.common.errors import UsageError
from aerpaw_cmp.site.materials import MATERIALS, material


# values that Sionna RT 2.2.0 computes at 3.4 GHz
@pytest.mark.parametrize(
    ("name", "real", "conductivity"),
    [
        ("concrete", 5.24, 0.120),
        ("wood", 1.99, 0.0174),
        ("medium_dry_ground", 13.27, 0.257),
        ("wet_ground", 18.39, 0.736),
        ("very_dry_ground", 3.0, 0.0033),
        ("brick", 3.91, 0.029),
        ("metal", 1.0, 1e7),
    ],
)
def test_values_at_3400_mhz(name: str, real: float, conductivity: float) -> None:
    it = material("itu_" + name)
    assert it.name == name
    assert it.relative_permittivity(3.4e9).real == pytest.approx(real, abs=0.005)
    assert it.conductivity_s_per_m(3.4e9) == pytest.approx(conductivity, rel=0.015)


def test_imaginary_part_gives_the_attenuation_of_a_conductor() -> None:
    # for weak loss the amplitude falls as exp(-sigma eta0 / (2 n) d): 120 pi ohm is a route without eps0
    wood = material("wood")
    index = wood.relative_permittivity(3.4e9) ** 0.5
    per_metre = -2 * math.pi * 3.4e9 / 299792458.0 * index.imag
    expected = wood.conductivity_s_per_m(3.4e9) * 376.730313 / (2 * index.real)
    assert index.imag < 0  # loss, for exp(+j omega t)
    assert per_metre == pytest.approx(expected, rel=1e-6)


def test_ground_is_a_half_space_and_walls_are_not() -> None:
    assert material("medium_dry_ground").thickness_m is None
    assert material("concrete").thickness_m == 0.3
    for name in MATERIALS:
        thickness = material(name).thickness_m
        assert thickness is None or 0 < thickness < 1


def test_bands_are_held() -> None:
    with pytest.raises(
        UsageError, match=r"medium_dry_ground.* at 28 GHz; expected 1-10 GHz, or in site.yaml"
    ) as caught:
        material("medium_dry_ground").relative_permittivity(28e9)
    proposed = material(
        str(caught.value.expected).split("'")[1].split(": ")[1]
    )  # what the message proposes can be used
    at_edge = material("medium_dry_ground").relative_permittivity(10e9).real
    assert proposed.relative_permittivity(28e9).real == pytest.approx(at_edge)
    with pytest.raises(UsageError, match="MHz or GHz where hertz"):
        material("concrete").relative_permittivity(3400.0)


def test_unknown_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'medium_dry_ground'"):
        material("itu_medium_dry_grund")
    with pytest.raises(UsageError, match=r"expected one of vacuum, concrete"):
        material("unobtainium")
