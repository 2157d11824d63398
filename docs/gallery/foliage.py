"""Loss through crowns

The loss of `rt.foliage: attenuating` (ITU-R P.833) at 3.4 GHz against the length of the path inside crowns, for both
values of `rt.leaves`. The loss of short paths is proportional to their length; that of long paths approaches 42 dB.
"""

import matplotlib.pyplot as plt
import numpy as np

from aerpaw_cmp.propagation.field.foliage import foliage_model

depth_m = np.linspace(0.0, 120.0, 400)
figure, axes = plt.subplots(figsize=(7, 3.2))
for label, in_leaf in (("in leaf", True), ("without leaves", False)):
    axes.plot(depth_m, foliage_model("attenuating", 3.4e9, in_leaf=in_leaf).loss_db(depth_m), label=label)
axes.set(xlabel="Path inside crowns [m]", ylabel="Loss [dB]")
axes.legend()
