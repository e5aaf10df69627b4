"""The layout of a run folder `fgtrack-run/1`: its tables and their columns."""

from collections.abc import Mapping

from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES

RUN_FORMAT = "fgtrack-run/1"
LARGEST_META_MB = 16.0
"""Of meta.json and config.yaml, which have some kB."""

#: States whose covariance is written.
COVARIANCE_STATES = ("x", "y", "yaw", "speed", "yaw_rate")

#: Upper triangle of the covariance, row by row.
COVARIANCE_COLUMNS = tuple(f"p_{a}_{b}" for i, a in enumerate(COVARIANCE_STATES) for b in COVARIANCE_STATES[i:])

#: Columns of every table of a run folder, in their order.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "tracks": (
        *("tick", "now_ns", "stamp_ns", "track_id", "status"),
        *STATE_NAMES,
        "num_measured",
        *COVARIANCE_COLUMNS,
    ),
    "updates": (
        *("tick", "sensor", "stamp_ns", "receipt_ns", "index", "disposition", "track_id", "nis"),
        *(f"res_{name}" for name in MEASURABLE),
    ),
    "timing": ("tick", "now_ns", "process_ns", "num_tracks", "num_detections"),
    "smoothed": ("track_id", "stamp_ns", "kind", *STATE_NAMES, *COVARIANCE_COLUMNS),
    "lagged": ("tick", "now_ns", "lag_s", "track_id", "stamp_ns", *STATE_NAMES, *COVARIANCE_COLUMNS),
    "truth": ("stamp_ns", "object_id", *STATE_NAMES),
    "ignored": ("stamp_ns", "object_id", "x_m", "y_m", "outline_m"),
    "ego": ("stamp_ns", "receipt_ns", *STATE_NAMES),
    "objects": ("track_id", "class_name", "class_share", "length_m", "width_m", "height_m"),
    "detections": ("sensor", "stamp_ns", "receipt_ns", "index", "frame", *MEASURABLE, *DESCRIBING),
}

#: Tables that are written only when there is something to write.
OPTIONAL_TABLES = ("smoothed", "lagged", "truth", "ignored", "ego", "objects", "detections")
