"""A tracker that takes object lists and odometry from zenoh, and notices every message that is lost on the way.

python docs/live/zenoh_tracker.py --listen tcp/127.0.0.1:7447
"""

import argparse
import json
import struct
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict

import zenoh
from loop import Received, run
from rosbags.serde import SerdeError
from zenoh_messages import (
    Numbers,
    cdr_to_ego,
    cdr_to_list,
    objects_to_cdr,
    read_attachment,
)

import fgtrack

LISTS, ODOMETRY, SENT = "vehicle/lists/", "vehicle/odometry", "vehicle/sent"


class Inlet:
    """What comes from the vehicle, as messages for the tracker.

    With `sim_time`, the clock is that of the vehicle: the newest time at which it has sent something.
    """

    def __init__(self, sim_time: bool) -> None:
        self._sim_time = sim_time
        self._vehicle_ns = 0
        self.numbers: dict[str, Numbers] = {}
        self.unreadable: Counter[str] = Counter()

    def now_ns(self) -> int:
        """The clock of receipts and ticks."""
        return self._vehicle_ns if self._sim_time else time.time_ns()

    def messages(self, samples: Iterable[zenoh.Sample]) -> Iterator[Received]:
        """Messages, until the vehicle reports how many it has sent; those that cannot be read are counted."""
        for sample in samples:
            topic, data = str(sample.key_expr), sample.payload.to_bytes()
            if topic == SENT:
                for of_topic, count in json.loads(data).items():
                    self.numbers.setdefault(of_topic, Numbers()).expect(count)
                return
            try:
                number, sent_ns = read_attachment(sample.attachment.to_bytes() if sample.attachment else b"")
                self.numbers.setdefault(topic, Numbers()).add(number)
                self._vehicle_ns = max(self._vehicle_ns, sent_ns)
                if topic == ODOMETRY:
                    yield cdr_to_ego(data, self.now_ns())
                else:
                    yield cdr_to_list(data, topic.removeprefix(LISTS), self.now_ns())
            except (SerdeError, struct.error):
                self.unreadable[topic] += 1


def main() -> None:
    """Track until the vehicle has sent everything, and report the outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447")
    parser.add_argument("--sim-time", action="store_true", help="by the clock of the vehicle")
    parser.add_argument("--estimator", default="smoother-banded")
    arguments = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([arguments.listen]))
    config.insert_json5("scouting/multicast/enabled", "false")
    tracker = fgtrack.Tracker.from_config("smoother", map="oval", estimator=arguments.estimator)
    inlet = Inlet(arguments.sim_time)
    with zenoh.open(config) as session:
        tracks = session.declare_publisher("tracks", congestion_control=zenoh.CongestionControl.BLOCK)

        def publish(stamp_ns: int, reports: tuple[fgtrack.TrackReport, ...]) -> None:
            found = [(str(track.track_id), track.x_m, track.y_m, track.yaw_rad) for track in reports]
            tracks.put(objects_to_cdr(stamp_ns, "map", found))

        # a full channel makes the vehicle wait
        with session.declare_subscriber("vehicle/**", zenoh.handlers.FifoChannel(1000)) as subscriber:
            print("ready", flush=True)
            run(tracker, inlet.messages(subscriber), publish, inlet.now_ns)
        summary = {
            "received": {topic: numbers.received for topic, numbers in inlet.numbers.items()},
            "lost": {topic: len(numbers.missing) for topic, numbers in inlet.numbers.items()},
            "repeated": {topic: numbers.repeated for topic, numbers in inlet.numbers.items()},
            "unreadable": inlet.unreadable,
            "counts": tracker.counts,
            "refused": tracker.refused,
            "failures": tracker.failures,
            "delay_median_s": {sensor: late.delay_median_s for sensor, late in tracker.lateness.items()},
            "timing": asdict(tracker.timing),
        }
        session.put("tracker/summary", json.dumps(summary))
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
