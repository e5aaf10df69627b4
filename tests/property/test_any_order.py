"""Drawn scenes: any order of arrival inside the horizon gives the same final tracks."""

from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fgtrack.testing.drawn_scenes import KINDS, drawn
from fgtrack.testing.outcomes import CONVERGED, Tolerance, difference, outcome

#: Drawn scenes are not shrunk: it takes minutes.
DRAWN = (Phase.explicit, Phase.generate)
MERGES: list[dict[str, Any]] = [
    {"kind": "none"},
    {"kind": "connected", "distance_m": 1.5},
]
PLACING = tuple(sorted(KINDS.keys() - {"bearing"}))


@st.composite
def scenes(draw: st.DrawFn, num_objects: int = 15) -> dict[str, Any]:
    """Draw the arguments of `drawn`: two or three sensors, one of which gives positions."""
    others = st.lists(
        st.sampled_from(sorted(KINDS)), min_size=1, max_size=2, unique=True
    )
    return {
        "seed": draw(st.integers(0, 2**32 - 1)),
        "kinds": [draw(st.sampled_from(PLACING)), *draw(others)],
        "num_objects": draw(st.integers(1, num_objects)),
        "length_s": 3.0,
        "detected": draw(st.floats(0.5, 1.0)),
        "clutter": draw(st.floats(0.0, 4.0)),
        "frame": draw(st.sampled_from(["ego", "map"])),
        "merge": draw(st.sampled_from(MERGES)),
        "jump_m": draw(st.sampled_from([0.0, 8.0, 30.0])),
    }


def check(
    drawing: dict[str, Any],
    seed: int,
    late_ego_s: float,
    estimator: str = "ekf-replay",
    tolerance: Tolerance | None = None,
) -> None:
    """Assert that late messages give the tracks of the messages in order.

    A jump of the ego is judged in the order of arrival, so an ego that jumps is not late.
    """
    if drawing["jump_m"]:
        late_ego_s = 0.0
    scene = drawn(**drawing).with_estimator(estimator)
    assert (
        difference(
            outcome(scene.late(seed, 0.9, late_ego_s)), outcome(scene), tolerance
        )
        == ""
    )


@settings(max_examples=3, deadline=None, phases=DRAWN, derandomize=True)
@given(drawing=scenes(5), late_ego_s=st.sampled_from([0.0, 0.3]))
def test_any_order_gives_the_same_final_tracks(
    drawing: dict[str, Any], late_ego_s: float
) -> None:
    check(drawing, 1, late_ego_s)


@pytest.mark.slow
@settings(max_examples=100, deadline=None, phases=DRAWN)
@given(
    drawing=scenes(), seed=st.integers(0, 1000), late_ego_s=st.sampled_from([0.0, 0.3])
)
def test_any_order_in_many_scenes(
    drawing: dict[str, Any], seed: int, late_ego_s: float
) -> None:
    check(drawing, seed, late_ego_s)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["smoother-banded", "smoother"])
@settings(max_examples=20, deadline=None, phases=DRAWN)
@given(
    drawing=scenes(), seed=st.integers(0, 1000), late_ego_s=st.sampled_from([0.0, 0.3])
)
def test_any_order_with_smoothers(
    estimator: str, drawing: dict[str, Any], seed: int, late_ego_s: float
) -> None:
    # One step per yaw is far from converged.
    kinds = ["position" if each == "yaw" else each for each in drawing["kinds"]]
    check({**drawing, "kinds": kinds}, seed, late_ego_s, estimator, CONVERGED)
