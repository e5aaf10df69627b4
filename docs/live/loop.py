"""A tracker in any Python program: a thread receives, the loop ticks and publishes.

python docs/live/loop.py
"""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import fgtrack

PERIOD_NS = 20_000_000  # 50 Hz, as `clock.node_hz`
PUBLISHED_AGO_NS = 100_000_000  # waiting makes the tracks better: late detections have come by then

Received = fgtrack.EgoState | fgtrack.DetectionList


def run(
    tracker: fgtrack.Tracker,
    source: Iterable[Received],
    publish: Callable[[int, tuple[fgtrack.TrackReport, ...]], None],
    now_ns: Callable[[], int] = time.time_ns,
) -> None:
    """Track until the source ends; what it gives is stamped with its receipt by the clock `now_ns`."""
    receiver = threading.Thread(target=lambda: [tracker.receive(message) for message in source], daemon=True)
    receiver.start()
    while now_ns() == 0 and receiver.is_alive():  # simulated time has not begun
        time.sleep(0.001)
    due_ns = now_ns() // PERIOD_NS * PERIOD_NS
    while receiver.is_alive():
        due_ns = max(due_ns + PERIOD_NS, now_ns() // PERIOD_NS * PERIOD_NS)  # after a long tick: skip some
        while 0 < (left_ns := due_ns - now_ns()) <= PERIOD_NS and receiver.is_alive():
            time.sleep(min(left_ns / 1e9, 0.001))
        if not receiver.is_alive():
            break
        if left_ns > PERIOD_NS:  # the clock was set back
            due_ns = now_ns() // PERIOD_NS * PERIOD_NS
        tracker.tick(due_ns)
        publish(due_ns - PUBLISHED_AGO_NS, tracker.tracks_at(due_ns - PUBLISHED_AGO_NS))
    tracker.tick(due_ns)  # what came last


def drive(duration_s: float) -> Iterator[Received]:
    """Instead of your sensors: a simulated drive, each message when it is due."""
    shift_ns = None
    for message in fgtrack.simulate("single_opponent", seed=1, duration_s=duration_s):
        if isinstance(message, fgtrack.TruthState):
            continue
        shift_ns = time.time_ns() - message.receipt_ns if shift_ns is None else shift_ns
        time.sleep(max(message.receipt_ns + shift_ns - time.time_ns(), 0) / 1e9)
        yield replace(message, stamp_ns=message.stamp_ns + shift_ns, receipt_ns=time.time_ns())


def show(stamp_ns: int, tracks: tuple[fgtrack.TrackReport, ...]) -> None:
    """Instead of your topic."""
    for track in tracks:
        print(f"{stamp_ns} track {track.track_id}: {track.x_m:.1f} m, {track.y_m:.1f} m, {track.status}")


if __name__ == "__main__":
    tracker = fgtrack.Tracker.from_config("smoother", map="oval")
    run(tracker, drive(duration_s=5.0), show)
    print(*tracker.lateness.items(), tracker.timing, tracker.counts, tracker.refused, tracker.failures, sep="\n")
