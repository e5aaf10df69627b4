"""The maps that the configuration of a run names: roads with their lines."""

from pathlib import Path

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.io.run import Run
from fgtrack.models.oval import OVAL, make_oval, make_pit_lane
from fgtrack.models.road import OPEN_SPACE
from fgtrack.models.track_map import TrackMap

_BOUND_STEP_M = 2.0


def roads(run: Run) -> tuple[dict[str, TrackMap], list[str]]:
    """Return the maps that the configuration names, by `track` and `pit`, and a line for each file that is gone.

    Raises `DataError` if a file is not a map.
    """
    result, notes = {}, []
    config = run.config.get("map") or {}
    for key, built_in in (("track", make_oval), ("pit", make_pit_lane)):
        name = config.get(key)
        if name == OVAL:
            result[key] = built_in()
        elif name and Path(str(name)).is_file():
            result[key] = TrackMap.read(Path(str(name)))
        elif name and name != OPEN_SPACE:
            notes.append(f"map.{key}: {name} is not there any more, so it is not shown")
    return result, notes


def road_lines(road: TrackMap) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the left bound, the right bound and the reference line of `road`, each of shape (n, 2)."""
    s_m = np.linspace(0.0, road.length_m, max(2, round(road.length_m / _BOUND_STEP_M)) + 1)
    left_m, right_m = road.bounds(s_m)
    return road.position(s_m, left_m), road.position(s_m, -right_m), road.position(s_m, np.zeros_like(s_m))
