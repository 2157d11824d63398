"""Antenna patterns

Gain of the patterns of `antenna: {model: ...}` against elevation. Measured patterns are read from files.
"""

import matplotlib.pyplot as plt
import numpy as np

from aerpaw_cmp.site.antennas import TR38901, HalfWaveDipole, Isotropic

elevation_deg = np.linspace(-90.0, 90.0, 361)
theta = np.radians(90.0 - elevation_deg)
figure, axes = plt.subplots(figsize=(7, 3.2))
for antenna in (Isotropic(), HalfWaveDipole(), TR38901()):
    e_theta, e_phi = antenna.field(theta, np.zeros_like(theta))
    gain_db = 10 * np.log10(np.maximum(np.abs(e_theta) ** 2 + np.abs(e_phi) ** 2, 1e-4))
    axes.plot(elevation_deg, gain_db, label=antenna.name)
axes.set(xlabel="Elevation [deg]", ylabel="Gain [dBi]", ylim=(-30, 12))
axes.legend()
