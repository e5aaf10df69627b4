"""When the messages of a run were sensed, sent, received and used, by topic, where its recording knows it."""

from dataclasses import dataclass

import numpy as np
from pydantic import TypeAdapter, ValidationError

from fgtrack.core.errors import FgtrackError
from fgtrack.core.types import IntArray
from fgtrack.io.config import InputConfig
from fgtrack.io.ros.bag import Bag
from fgtrack.io.ros.topics import topic_uses
from fgtrack.io.run import Run, recording_of
from fgtrack.io.source import input_kind

_RECORDING = "recording"


@dataclass(frozen=True)
class Sendings:
    """The n messages of one topic."""

    topic: str
    role: str
    """`ego`, `detections SENSOR`, `truth`, or `messages`."""
    sensed_ns: IntArray
    """Stamp of the header, shape (n,)."""
    sent_ns: IntArray
    """Shape (n,)."""
    received_ns: IntArray
    """Shape (n,)."""
    used_ns: IntArray
    """Time of the tick that took the message, shape (n,); -1 where no tick did."""


def sendings(run: Run) -> list[Sendings]:
    """The messages of each topic that `run` read and whose time of sending its recording knows.

    None where the recording is not there any more or is damaged, and where it does not know: only MCAP files hold that
    time, and a recorder to which it was not told writes the time of receipt.
    """
    origin = recording_of(run)
    try:
        if origin is None or input_kind(origin) != _RECORDING:
            return []
        config = TypeAdapter(InputConfig).validate_python(run.config.get("input") or {})
        bag = Bag(origin, config.message_definitions, config.largest_bytes)
        roles = {use.topic: use.role for use in topic_uses(bag, config)}
        times: dict[str, list[tuple[int, int, int]]] = {}
        by_name = {topic.name: role for topic, role in roles.items()}
        for topic, stamp_ns, sending_ns, receipt_ns in bag.sendings():
            if topic in roles:
                times.setdefault(topic.name, []).append((stamp_ns, sending_ns, receipt_ns))
    except (FgtrackError, ValidationError):
        return []
    found = []
    for name, rows in sorted(times.items()):
        sensed_ns, sent_ns, received_ns = np.array(rows, dtype=np.int64).T
        if (sent_ns != received_ns).any():
            used_ns = _used_ns(run, received_ns)
            found.append(Sendings(name, by_name[name], sensed_ns, sent_ns, received_ns, used_ns))
    return found


def _used_ns(run: Run, received_ns: IntArray) -> IntArray:
    """Time of the first tick at or after each receipt; -1 where there is none."""
    ticks_ns = run.timing["now_ns"]
    if not len(ticks_ns):
        return np.full(len(received_ns), -1)
    place = np.searchsorted(ticks_ns, received_ns)
    inside = place < len(ticks_ns)
    return np.where(inside, ticks_ns[np.minimum(place, len(ticks_ns) - 1)], -1)
