"""A log folder as the published node writes it, of its recorded runs: the replay of the log is that of the stream."""

import gzip
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from published_reception import SENSORS, PublishedReception
from support.examples import slow
from support.messages import shared

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import STATE_NAMES
from fgtrack.inputs.stream import read_stream
from fgtrack.pipeline.public import replay

RUNS = ("short10", "lidar3_10", "jitter10", "full60")
COLUMNS = (
    "time_ns",
    "detection_input",
    "ego_state",
    "tracking_input",
    "match_dict",
    "filter_log",
    "object_dict",
    "pred_dict",
    "cycle_time_ns",
)

#: The log holds the ego after the low-pass, which must not be done again, and a row where something came.
AS_LOGGED = {"ego.yaw_weight": 1.0, "ego.yaw_rate_weight": 1.0, "clock.node_hz": None}


def log_rows(name: str, ticks_ns: list[int]) -> Iterator[tuple[Any, ...]]:
    """What the node logs at every tick: its inbox, and the ego at the end of the tick."""
    reception = PublishedReception()
    messages = list(read_stream(shared(f"reference/{name}/stream.jsonl.gz")))
    for now_ns in ticks_ns:
        while messages and messages[0].receipt_ns <= now_ns:
            reception.receive(messages.pop(0))
        found = {
            sensor: [
                [
                    {"state": state, "t": slot[1], "keys": keys(sensor)}
                    for state in slot[0]
                ],
                slot[1],
            ]
            for sensor, slot in reception.slots.items()
            if slot is not None
        }
        reception.collect()
        reception.store_ego()
        if reception.ego is not None:
            stamp_ns, state = reception.ego
            ego = {
                "is_updated": True,
                "in_pit": reception.in_pit,
                "t": stamp_ns,
                "state": state,
            }
            yield (now_ns, found or None, ego, [], {}, {}, {}, {}, 1)


def keys(sensor: str) -> list[str]:
    """What the node says that the objects of a sensor hold; the yaw comes from the map after logging."""
    return (
        ["x", "y", "yaw", "v"] if SENSORS[sensor].measures_speed else ["x", "y", "yaw"]
    )


@pytest.mark.parametrize("name", [RUNS[0], *slow(*RUNS[1:])])
def test_a_log_folder_replays_to_the_tracks_of_the_stream(
    name: str, tmp_path: Path
) -> None:
    with gzip.open(shared(f"reference/{name}/expected.jsonl.gz")) as file:
        expected = [json.loads(line) for line in file]
    rows = list(log_rows(name, [tick["now_ns"] for tick in expected]))
    lines = [";".join(COLUMNS), *(";".join(map(json.dumps, row)) for row in rows)]
    (tmp_path / "data_logs.csv").write_text("\n".join(lines))
    maps = {
        lane: shared(f"data/maps/lvms_{file}.csv")
        for lane, file in (("map", "track"), ("pit_map", "pitlane"))
    }
    run = replay(tmp_path, "karle2023_reference", set=AS_LOGGED, **maps)
    egos_ns = [0, *(ego["t"] for _, _, ego, *_ in rows)]
    ticks = [
        row[0]
        for row, before_ns in zip(rows, egos_ns, strict=False)
        if row[1] or row[2]["t"] != before_ns
    ]
    assert run.timing["now_ns"].tolist() == ticks
    assert len(expected) - len(ticks) <= 2  # nothing came in some
    wanted = [
        (tick["now_ns"], int(track_id), state["num_measured"], *state["x"])
        for tick in expected
        for track_id, state in tick["objects"].items()
        if tick["now_ns"] in ticks
    ]
    names = ("now_ns", "track_id", "num_measured", *STATE_NAMES)
    given = np.stack([run.tracks[name].astype(np.float64) for name in names], axis=-1)
    assert given.shape == (len(wanted), len(names))
    order, wanted_order = (
        np.lexsort(table[:, :2].T[::-1]) for table in (given, np.array(wanted))
    )
    errors = given[order] - np.array(wanted)[wanted_order]
    errors[:, 5] = wrap_angles(errors[:, 5])
    assert np.abs(errors).max() < 1e-9
