"""
Live use
========

Messages go in as they arrive, tracks come out at every tick. Nothing that arrives can end the tracker: what cannot be
used is counted. The page "Live use" (docs/live.md) has complete hosts: a loop, a ROS 2 node, zenoh.
"""

import matplotlib.pyplot as plt
import numpy as np

import fgtrack

# %%
# In a node, the subscriptions call `receive`. Here a simulated drive gives the messages, in the order of their receipt.
messages = fgtrack.simulate("single_opponent", seed=1, duration_s=5.0)
tracker = fgtrack.Tracker.from_config("smoother", map="oval")

PERIOD_NS = 20_000_000  # 50 Hz
rows = []
now_ns = None
for message in messages:
    if isinstance(message, fgtrack.TruthState):
        continue
    if now_ns is None:
        now_ns = message.receipt_ns + PERIOD_NS
    while message.receipt_ns > now_ns:
        report = tracker.tick(now_ns)
        rows += [(now_ns, track.track_id, track.speed_mps, track.covariance[3, 3]) for track in report.tracks]
        now_ns += PERIOD_NS
    tracker.receive(message)

# %%
# Tracks have their state by name, and a covariance.
for track in report.tracks:
    print(f"track {track.track_id}: {track.x_m:.1f} m, {track.y_m:.1f} m, {track.speed_mps:.1f} m/s, {track.status}")

# %%
# The state at any stamp in the window, not only now: the smoothed state 0.3 s ago.
past = tracker.state_at(track.track_id, now_ns - 300_000_000)
print(np.round(past.state.mean, 2))

# %%
# All tracks for a time of your choice, here 0.1 s ago.
print(len(tracker.tracks_at(now_ns - 100_000_000)))

# %%
# A sensor without a configuration, and a clock that runs backwards: counted, with a reason.
stranger = fgtrack.DetectionList("sonar", now_ns, now_ns, (fgtrack.Detection(x_m=1.0, y_m=0.0),))
tracker.receive(stranger)
tracker.tick(now_ns)
tracker.tick(now_ns - PERIOD_NS)
print(dict(tracker.refused))

# %%
# What became of every detection so far.
for sensor, counts in tracker.counts.items():
    print(sensor, counts)

# %%
# How late every sensor is.
for sensor, late in tracker.lateness.items():
    if late.messages:
        print(f"{sensor}: median {late.delay_median_s:.3f} s, worst {late.delay_worst_s:.3f} s")

# %%
time_s = (np.array([row[0] for row in rows]) - rows[0][0]) / 1e9
speed_mps, std_mps = np.array([row[2] for row in rows]), np.sqrt([row[3] for row in rows])
figure, axes = plt.subplots()
axes.fill_between(time_s, speed_mps - 2 * std_mps, speed_mps + 2 * std_mps, alpha=0.3, label="two standard deviations")
axes.plot(time_s, speed_mps, label="track")
axes.set(xlabel="time [s]", ylabel="speed [m/s]")
axes.legend()
