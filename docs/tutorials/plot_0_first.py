"""
From a recording to a plot
==========================

A recording, or messages, goes in; a run of tables comes out. Here: does the NIS grow with the delay of a detection?
"""

import matplotlib.pyplot as plt

import fgtrack

recording = list(fgtrack.simulate("single_opponent", seed=1, duration_s=6.0))  # or a path: "drive.mcap"
run = fgtrack.replay(recording, "smoother", map="oval")
delay_ms = (run.updates["receipt_ns"] - run.updates["stamp_ns"]) / 1e6
figure, axes = plt.subplots()
for sensor in ("lidar_cluster", "radar"):
    of_sensor = run.updates["sensor"] == sensor
    axes.scatter(delay_ms[of_sensor], run.updates["nis"][of_sensor], s=6, label=sensor)
axes.set(xlabel="delay [ms]", ylabel="NIS")
axes.legend()
