"""Ground reflection against distance

Level of a UAV at 30 m that flies away from a tower of 10 m over flat ground at 3.4 GHz: direct ray alone, and with the
ground reflection. The closed form (`two_ray_dbm`) and the replay (image method, channel matrices) are separate
implementations with the same result.
"""

import matplotlib.pyplot as plt
import numpy as np

import aerpaw_cmp as ac
from aerpaw_cmp.propagation.field.baselines import free_space_dbm, two_ray_dbm

carrier_hz = 3.4e9
site = ac.load_site("lake_wheeler")
tower_m = site.towers["LW1"].position_m
distance_m = np.geomspace(20.0, 2000.0, 1200)
poses_m = tower_m + np.column_stack([0 * distance_m, -distance_m, 0 * distance_m + 30.0 - tower_m[2]])

link = ac.Link(carrier_hz, {"LW1": ac.single_element()}, ac.single_element(), transmit_power_dbm=0.0)
replay = ac.trace(site, link, poses_m, max_depth=1)

figure, axes = plt.subplots(figsize=(7, 3.6))
axes.semilogx(distance_m, replay.rss_dbm[:, 0], label="replay")
axes.semilogx(distance_m, two_ray_dbm(tower_m[None], poses_m, carrier_hz)[:, 0], "k:", label="two-ray, closed form")
axes.semilogx(distance_m, free_space_dbm(tower_m[None], poses_m, carrier_hz)[:, 0], label="free space")
axes.set(xlabel="Horizontal distance [m]", ylabel="Level for 0 dBm transmitted [dBm]")
axes.legend()
