"""Measured and replayed level of the sample flight

From the logs to a comparison in ten lines of the library. The sample flight is synthetic.
"""

import matplotlib.pyplot as plt

import aerpaw_cmp as ac
from aerpaw_cmp.jobs.sample import sample_folder

flight = ac.open_flight(sample_folder() / "flight.yaml")
replayed = flight.replay(max_depth=1)
(tower, channel), level = next(iter(replayed.rss_dbm.items()))
measured = flight.rss.query("tower == @tower and channel == @channel")
fit = ac.grid_offset(measured.measured_db, level)

figure, axes = plt.subplots(figsize=(7, 3.4))
axes.plot(
    measured.time, measured.measured_db + fit.offset_db, ".", markersize=2, label=f"measured + {fit.offset_db:.1f} dB"
)
axes.plot(measured.time, level, linewidth=1, label=f"replayed, RMSE {fit.rmse_db:.1f} dB")
axes.set(title=f"{tower} {channel}", xlabel="UTC", ylabel="RSS [dBm]")
axes.legend()
figure.autofmt_xdate()
