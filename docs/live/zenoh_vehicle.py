"""A vehicle that sends object lists and odometry through zenoh, as its sensors give them: late.

    python docs/live/zenoh_vehicle.py --connect tcp/127.0.0.1:7447

It is simulated. Its clock is that of the simulation, which waits for the tracker: it never is more than half a second
ahead of the tracks that come back.
"""

import argparse
import json
import threading
import time
from collections import Counter

import zenoh
from zenoh_messages import attachment, objects_to_cdr, odometry_to_cdr, stamp_of

import fgtrack

AHEAD_NS = 500_000_000


class Tracks:
    """What the tracker publishes."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self._news = threading.Condition()

    def take(self, sample: zenoh.Sample) -> None:
        """Tracks have come."""
        with self._news:
            self.stamps_ns.append(stamp_of(sample.payload.to_bytes()))
            self._news.notify()

    def wait_for(self, stamp_ns: int) -> None:
        """Come back when tracks of this stamp or later have come; after a second in any case."""
        with self._news:
            self._news.wait_for(lambda: self.stamps_ns and self.stamps_ns[-1] >= stamp_ns, timeout=1.0)


def drive(session: zenoh.Session, tracks: Tracks, duration_s: float, max_lists: int, lose_every: int) -> Counter[str]:
    """Send the messages of a drive; gives how many, by topic, those that `lose_every` loses on purpose included."""
    publishers: dict[str, zenoh.Publisher] = {}
    sent: Counter[str] = Counter()
    lists, begun_ns = 0, None
    for message in fgtrack.simulate("single_opponent", seed=1, duration_s=duration_s):
        if isinstance(message, fgtrack.TruthState):
            continue
        if isinstance(message, fgtrack.EgoState):
            topic, data = "vehicle/odometry", odometry_to_cdr(message)
        else:
            if lists == max_lists:
                break
            lists += 1
            topic = f"vehicle/lists/{message.sensor}"
            objects = [(str(k), seen.x_m, seen.y_m, seen.yaw_rad or 0.0) for k, seen in enumerate(message.objects)]
            data = objects_to_cdr(message.stamp_ns, "base_link", objects)
        begun_ns = message.receipt_ns if begun_ns is None else begun_ns
        if message.receipt_ns > begun_ns + AHEAD_NS:
            tracks.wait_for(message.receipt_ns - AHEAD_NS)
        if topic not in publishers:  # wait rather than drop, where the network is slower than we are
            publishers[topic] = session.declare_publisher(topic, congestion_control=zenoh.CongestionControl.BLOCK)
            while not publishers[topic].matching_status.matching:
                time.sleep(0.01)
        if not lose_every or sent[topic] % lose_every != lose_every - 1:
            publishers[topic].put(data, attachment=attachment(sent[topic], message.receipt_ns))
        sent[topic] += 1
    return sent


def main() -> None:
    """Drive, report how much was sent, and which tracks came back."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447")
    parser.add_argument("--duration-s", type=float, default=60.0)
    parser.add_argument("--max-lists", type=int, default=-1)
    parser.add_argument("--lose-every", type=int, default=0, help="lose each n-th message, to see it noticed")
    arguments = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([arguments.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    tracks = Tracks()
    done = threading.Event()

    with (
        zenoh.open(config) as session,
        session.declare_subscriber("tracks", tracks.take),
        session.declare_subscriber("tracker/summary", lambda _: done.set()),
    ):
        sent = drive(session, tracks, arguments.duration_s, arguments.max_lists, arguments.lose_every)
        while not done.wait(0.5):  # the last ones might be lost, too
            session.put("vehicle/sent", json.dumps(sent), congestion_control=zenoh.CongestionControl.BLOCK)
    stamps_ns = tracks.stamps_ns
    print(json.dumps({"sent": sent, "tracks": len(stamps_ns), "in_order": stamps_ns == sorted(stamps_ns)}))


if __name__ == "__main__":
    main()
