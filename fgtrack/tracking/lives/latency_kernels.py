"""Compiled loop over the sensors whose lists could still come."""

from fgtrack.core.compiled import inlined
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.tracking.lives.latency import FOREVER


@inlined
def decided_ns(
    own: int,
    watermarks_ns: IntArray,
    processed_ns: int,
    could_show: BoolArray,
    expected_ns: IntArray,
) -> int:
    """Return the stamp up to which all lists that could show the object of track `own` have come and are processed.

    `watermarks_ns` are the watermarks of the sensors, shape (sensors,). `could_show` (tracks, sensors) marks the
    sensors that could show the object at the newest stamp. `expected_ns` (tracks, sensors) are the newest stamps at
    which they could show it. A sensor counts if it could show the object now, or at a stamp whose list has not come.
    Returns `FOREVER` if no sensor counts.
    """
    decided = FOREVER
    for k in range(len(watermarks_ns)):
        watermark_ns = min(watermarks_ns[k], processed_ns)
        if could_show[own, k] or expected_ns[own, k] > watermark_ns:
            decided = min(decided, watermark_ns)
    return decided
