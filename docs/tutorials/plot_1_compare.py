"""
Compare a filter and a smoother
===============================

The same stream through three estimators: the smoother, the EKF that replays late detections, and the backward-forward
EKF of Karle et al. 2023.
"""

import fgtrack

# %%
# One car ahead, LiDAR 151 ms and RADAR 62 ms late on average. A path of a recording does as well as messages.
recording = list(fgtrack.simulate("single_opponent", seed=1, duration_s=8.0))

# %%
# `smoother` is a shipped configuration (`fgtrack config --list`); every estimator gets the same association, births and
# noise. Settings can be changed one by one: here the lags of the smoother's output.
settings = {"smoother.lagged_s": [0.1, 0.2, 0.3, 0.5]}
runs = [
    fgtrack.replay(recording, "smoother", map="oval", estimator=name, set=settings)
    for name in ("smoother", "ekf-replay", "ekf-backward-forward")
]

# %%
# The present states. Backward-forward is not a replay: a late LiDAR update erases the RADAR updates fused since. The
# replaying EKF and the smoother keep them and nearly tie.
tables = fgtrack.compare(*runs)
print(tables[["tracking"]])

# %%
# The past. The smoother's states 0.1 to 0.5 s ago contain what has arrived since; a filter has no such output.
print(tables[["lag"]])
fgtrack.plot.lag(runs)

# %%
# Errors over time, and the outcome of every detection.
fgtrack.plot.errors(runs)

# %%
print(tables[["dispositions"]])

# %%
# Every table is a pandas DataFrame, those of a comparison and those of a run.
print(tables["tracking"][["run", "position_rmse_m"]])
print(runs[0].smoothed.dtypes)
