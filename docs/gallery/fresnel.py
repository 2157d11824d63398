"""Reflection coefficients of ground and walls

ITU-R P.2040: a half-space of ground, and a slab of concrete whose internal reflections cause the ripple. TM
(vertical over ground) has the pseudo-Brewster angle, where the ground reflection of a vertical antenna nearly vanishes.
"""

import matplotlib.pyplot as plt
import numpy as np

from aerpaw_cmp.propagation.field.fresnel import reflection_coefficients
from aerpaw_cmp.site.materials import material

carrier_hz = 3.4e9
grazing_deg = np.linspace(0.0, 90.0, 721)
figure, axes = plt.subplots(figsize=(7, 3.6))
for name, style in (("medium_dry_ground", "-"), ("concrete", "--")):
    kind = material(name)
    permittivity = np.full(grazing_deg.shape, kind.relative_permittivity(carrier_hz))
    thickness_m = np.full(grazing_deg.shape, np.inf if kind.thickness_m is None else kind.thickness_m)
    cosine = np.sin(np.radians(grazing_deg))
    te, tm = reflection_coefficients(cosine, permittivity, thickness_m, 299_792_458.0 / carrier_hz)
    axes.plot(grazing_deg, np.abs(te), style, color="tab:blue", label=f"TE, {name}")
    axes.plot(grazing_deg, np.abs(tm), style, color="tab:orange", label=f"TM, {name}")
axes.set(xlabel="Grazing angle [deg]", ylabel="Magnitude of the reflection")
axes.legend()
