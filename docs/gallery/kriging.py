"""Kriging of a field from a few samples

Level over a square of the site at 60 m: computed everywhere, and estimated from 60 random positions by ordinary Kriging
with the fitted correlation. The right picture is the standard deviation of the estimate.
"""

import matplotlib.pyplot as plt
import numpy as np

import aerpaw_cmp as ac

site = ac.load_site("lake_wheeler")
link = ac.Link(3.4e9, {"LW1": ac.single_element()}, ac.single_element())
axis_m = np.linspace(-400.0, 400.0, 41)
plan_m = np.column_stack([axis.ravel() for axis in np.meshgrid(axis_m, axis_m)])
level = ac.trace(site, link, np.column_stack([plan_m, np.full(len(plan_m), 60.0)])).rss_power_dbm[:, 0]

chosen = np.random.default_rng(0).choice(len(plan_m), 60, replace=False)
correlation = ac.Variogram(width_m=40.0).fit(plan_m, level[:, None]).model_
kriging = ac.OrdinaryKriging(correlation, radius_m=np.inf).fit(plan_m[chosen], level[chosen])
estimate, variance = kriging.predict(plan_m)

figure, panels = plt.subplots(1, 3, figsize=(9, 3), sharey=True, constrained_layout=True)
shown = {"Computed [dBm]": level, "Kriging [dBm]": estimate, "Standard deviation [dB]": np.sqrt(variance)}
for number, (axes, (title, values)) in enumerate(zip(panels, shown.items(), strict=True)):
    limits = {} if number == 2 else {"vmin": np.nanmin(level), "vmax": np.nanmax(level)}
    image = axes.pcolormesh(axis_m, axis_m, values.reshape(41, 41), rasterized=True, **limits)
    axes.plot(*plan_m[chosen].T, "k.", markersize=2)
    axes.set(title=title, xlabel="East [m]", aspect="equal")
    figure.colorbar(image, ax=axes, shrink=0.7)
panels[0].set_ylabel("North [m]")
