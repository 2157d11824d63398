"""Rank against distance for four spacings

Rank of a 4 x 4 link at K = 100 as the UAV flies away. Wide arrays at the tower keep their rank at longer
distances, because spherical wave fronts differ between their elements.
"""

import matplotlib.pyplot as plt
import numpy as np

import aerpaw_cmp as ac

carrier_hz = 3.4e9
wavelength_m = 299_792_458.0 / carrier_hz
site = ac.load_site("lake_wheeler")
tower_m = site.towers["LW1"].position_m
distance_m = np.linspace(30.0, 600.0, 200)
poses_m = np.column_stack([tower_m[0] + distance_m, np.full(200, tower_m[1]), np.full(200, 50.0)])

figure, axes = plt.subplots(figsize=(7, 3.2))
for spacing in (0.5, 2.0, 8.0, 32.0):
    tower = ac.linear_array(4, spacing * wavelength_m, yaw_deg=0.0)
    link = ac.Link(carrier_hz, {"LW1": tower}, ac.linear_array(4, 0.5 * wavelength_m, yaw_deg=0.0))
    rank = ac.channel_rank(ac.trace(site, link, poses_m, max_depth=1).h[:, 0], 100)
    axes.step(distance_m, rank + 0.04 * np.log2(spacing), where="mid", label=f"{spacing:g} wavelengths")
axes.set(xlabel="Horizontal distance [m]", ylabel="Rank at K = 100 (lines moved apart)")
axes.legend(title="Spacing at the tower")
