"""The arrays of the nodes of all windows, as compiled loops take them: columns, types and checks.

`nodes` are the eight `arrays` of `Nodes`, in that order. `seen` are its arrays `marks` (size, 3, rows) and `values`
(size, 16, rows), which hold the measurements of the nodes. A measurement of k components has k rows. What a measurement
has only once stands in its first row. Rows of `marks` are the code of a component, the number k, and the kind of the
robust loss. Rows of `values` are z, the sensor pose, the width of the loss, the time from the node to the measurement,
and the lower Cholesky root of R.
"""

import numpy as np

from fgtrack.core.compiled import check, check_rows, inlined
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.models.measurement_kernels import NUM_COMPONENTS, POSE_SIZE

#: A stamp or an index that is later than all others.
NEVER = int(np.iinfo(np.int64).max)
#: Stands where a row has no number of a node yet.
NONE = -1
#: Columns of `tracks`: see `Nodes`.
COUNT, FIRST, KNOWN, BEGIN_NS, NONLINEAR = range(5)
#: Levels of `NONLINEAR`: linear tracks, tracks with a nonlinear measurement, and with a robust loss.
NUM_LEVELS = 3
#: Columns of `labels`.
NUM_ROWS, INFORMED, STALE, ROWS_STALE, NUM_PLUGINS = range(5)
#: `blocks` of a node. `INFORMATION` [R | d] is the factor that elimination of the older nodes leaves on the node, with
#: R (x - x0) = d + N(0, I); it is up to date if the node is `INFORMED`.
C, FILTERED, PREDICTED, P, F, Q, INFORMATION = range(7)
#: Rows of `marks`, rows of `values`, and the number of rows of `values`.
CODE, SIZE, LOSS = range(3)
Z, POSE, WIDTH, AHEAD_S, ROOT = 0, 1, 1 + POSE_SIZE, 2 + POSE_SIZE, 3 + POSE_SIZE
NUM_VALUES = ROOT + NUM_COMPONENTS
#: Stands instead of the kind of a loss if a plug-in models the measurement: compiled loops do not contain the model.
PLUGIN = -1
#: Types of arguments.
INDICES, TIMES, VECTORS, MATRICES = (
    "int64[::1]",
    "float64[::1]",
    "float64[:, ::1]",
    "float64[:, :, ::1]",
)
BLOCKS = "float64[:, :, :, ::1]"
NODES = f"Tuple(({'int64[:, ::1], ' * 4}{MATRICES}, {VECTORS}, {BLOCKS}, {MATRICES}))"
Arrays = tuple[
    IntArray,
    IntArray,
    IntArray,
    IntArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
]
"""See `Nodes.arrays`."""
SEEN = f"Tuple((int64[:, :, ::1], {MATRICES}))"
Seen = tuple[IntArray, FloatArray]
"""See `Nodes.seen`."""


@inlined
def check_track(track: int, nodes: Arrays, spare: int) -> None:
    """Raise `IndexError` if a track, or the number of one of its nodes, lies beyond the ends of the arrays.

    With `spare` 1 the track also needs the number of a further node.
    """
    info, all_ns, numbers, labels, backs, points, blocks, rows = nodes
    size, n = len(labels), points.shape[1]
    check(0 <= track < len(info))
    check(
        len(all_ns) == len(info)
        and len(numbers) == len(info)
        and all_ns.shape[1] == numbers.shape[1]
    )
    check(
        len(backs) == size
        and len(points) == size
        and len(blocks) == size
        and len(rows) == size
    )
    check(
        backs.shape[1] == n + 1
        and backs.shape[2] == n + 1
        and blocks.shape[2] == n
        and blocks.shape[3] == n + 1
    )
    check(rows.shape[2] == n + 1)
    own = info[track]
    check(
        0 <= own[FIRST] < own[COUNT] <= all_ns.shape[1] - spare
        and 0 <= own[KNOWN] <= own[COUNT]
    )
    check_rows(numbers[track, : own[COUNT] + spare], 0, size)


@inlined
def check_nodes(tracks: IntArray, nodes: Arrays, spare: int) -> None:
    """Check all `tracks`, see `check_track`."""
    for t in range(len(tracks)):
        check_track(tracks[t], nodes, spare)


@inlined
def check_indices(indices: IntArray, tracks: IntArray, nodes: Arrays) -> None:
    """Raise `IndexError` if a track lacks the node of its index; `indices` has one index for each of `tracks`."""
    check(len(indices) >= len(tracks))
    for t in range(len(tracks)):
        check_rows(indices[t : t + 1], 0, nodes[0][tracks[t], COUNT])


@inlined
def check_seen(nodes: Arrays, seen: Seen) -> None:
    """Raise `IndexError` unless the arrays of measurements are as large as the arrays of the nodes."""
    marks, values = seen
    _, _, _, labels, _, _, _, rows = nodes
    check(labels.shape[1] > NUM_PLUGINS)
    check(len(marks) == len(labels) and len(values) == len(labels))
    check(marks.shape[1] > LOSS and values.shape[1] >= NUM_VALUES)
    check(marks.shape[2] == rows.shape[1] and values.shape[2] == rows.shape[1])


@inlined
def last_before(all_ns: IntArray, count: int, stamp_ns: int) -> int:
    """Return the index of the newest node at or before `stamp_ns`; -1 without such a node."""
    index = count - 1
    while index >= 0 and all_ns[index] > stamp_ns:
        index -= 1
    return index
