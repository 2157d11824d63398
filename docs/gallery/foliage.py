"""Loss through crowns

The two models of `rt.foliage_model` at 3.4 GHz against the length of the path inside crowns. They differ by up to 2 dB,
less than most measurements of one flight can distinguish.
"""

import matplotlib.pyplot as plt
import numpy as np

from aerpaw_cmp.propagation.field.foliage import P833, Weissberger

depth_m = np.linspace(0.0, 120.0, 400)
figure, axes = plt.subplots(figsize=(7, 3.2))
axes.plot(depth_m, P833().loss_db(depth_m), label="ITU-R P.833")
axes.plot(depth_m, Weissberger(3.4e9).loss_db(depth_m), label="Weissberger, in leaf")
axes.set(xlabel="Path inside crowns [m]", ylabel="Loss [dB]")
axes.legend()
