"""`smoother-banded` on whole recordings: the tracks and dispositions of `smoother`, with equal thresholds."""

import numpy as np
import pytest
from support.examples import slow
from support.messages import shared

import fgtrack
from fgtrack.runs.schema import COVARIANCE_STATES

STATES = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
TOLERANCE = 1e-3  # standard deviations


def recording(name: str) -> dict[str, object]:
    """A recording, and the maps that belong to it."""
    if name == "default":
        messages = list(fgtrack.simulate("default", seed=1))
        until_ns = messages[0].receipt_ns + 8_000_000_000
        return {
            "recording": [
                message for message in messages if message.receipt_ns < until_ns
            ],
            "map": "oval",
        }
    maps = {
        key: shared(f"data/maps/lvms_{file}.csv")
        for key, file in (("map", "track"), ("pit_map", "pitlane"))
    }
    return {"recording": shared(f"reference/{name}/stream.jsonl.gz"), **maps}


@pytest.mark.parametrize(
    "name", ["default", *slow("short10", "lidar3_10", "jitter10", "full60")]
)
def test_whole_runs_are_those_of_the_smoother(name: str) -> None:
    given = recording(name)
    expected, found = (
        fgtrack.replay(config="smoother", estimator=estimator, **given)  # type: ignore[arg-type]  # by name
        for estimator in ("smoother", "smoother-banded")
    )
    for column in ("disposition", "track_id", "sensor", "stamp_ns", "index"):
        assert (found.updates[column] == expected.updates[column]).all()
    assert len(found.tracks["x_m"]) > 200
    for column in ("tick", "track_id", "stamp_ns", "num_measured"):
        assert (found.tracks[column] == expected.tracks[column]).all()
    for state, short in zip(STATES, COVARIANCE_STATES, strict=True):
        variance = expected.tracks[f"p_{short}_{short}"]
        apart = np.abs(found.tracks[state] - expected.tracks[state]) / np.sqrt(variance)
        assert np.nanmax(apart) < TOLERANCE
        assert (
            np.nanmax(np.abs(found.tracks[f"p_{short}_{short}"] / variance - 1.0))
            < TOLERANCE
        )
