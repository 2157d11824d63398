"""Why H is computed in float64

The phase of a path is the fractional part of its length in wavelengths. In float32 this number has an error of some
thousandths of a turn at 1 km and 3.4 GHz, which hides small singular values. The second singular value of a 4 x 4 line
of sight is then lost or wrong. The rank at K = 1000 jumps although nothing in the scene changes. In this
figure only the lengths are rounded to float32, once.
"""

import matplotlib.pyplot as plt
import numpy as np

from aerpaw_cmp.compare.rank import singular_values

wavelength_m = 299_792_458.0 / 3.4e9
distance_m = np.linspace(200.0, 2000.0, 400)
offsets_m = 0.5 * wavelength_m * np.arange(4)


def matrices(number):
    """Line-of-sight H (poses, 4, 4) of two parallel arrays, with lengths in ``number``."""
    apart_m = offsets_m[:, None] - offsets_m[None, :]
    length_m = np.hypot(distance_m[:, None, None], apart_m).astype(number)
    return np.exp(-2j * np.pi * (length_m / number(wavelength_m)).astype(np.float64)) / distance_m[:, None, None]


figure, axes = plt.subplots(figsize=(7, 3.6))
for number, style in ((np.float64, "-"), (np.float32, ".")):
    values = singular_values(matrices(number))
    axes.semilogy(distance_m, values[:, 1] / values[:, 0], style, label=f"lengths in {number.__name__}", markersize=3)
axes.axhline(1e-3, color="gray", linewidth=1)
axes.annotate("K = 1000", (1500.0, 1.2e-3))
axes.set(xlabel="Distance [m]", ylabel="Second singular value / first")
axes.legend()
