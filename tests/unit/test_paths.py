"""Paths of the ego and of true objects: where they are known, and where they lead."""

import numpy as np

from fgtrack.clocks.paths import EgoPath, true_paths
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EgoState, TruthState

START_NS = 1_600_000_000 * NS_PER_S


def at_ns(time_s: float) -> int:
    return START_NS + round(time_s * NS_PER_S)


def test_the_path_of_the_ego_is_known_from_its_first_state_to_its_last() -> None:
    states = [
        EgoState(at_ns(0.1 * k), at_ns(0.1 * k), 2.0 * k, 3.0, 0.5, 20.0)
        for k in range(11)
    ]
    times_ns = np.array(
        [at_ns(time_s) for time_s in (-0.01, 0.0, 0.05, 0.5, 1.0, 1.01)]
    )
    poses = EgoPath(states)(times_ns)
    assert np.isnan(poses).all(axis=1).tolist() == [
        True,
        False,
        False,
        False,
        False,
        True,
    ]
    expected = [[0.0, 3.0, 0.5], [1.0, 3.0, 0.5], [10.0, 3.0, 0.5], [20.0, 3.0, 0.5]]
    np.testing.assert_allclose(poses[1:-1], expected, atol=1e-9)


def test_the_path_of_a_true_object_leads_through_its_states_and_one_state_is_no_path() -> (
    None
):
    twice = [
        TruthState(at_ns(time_s), at_ns(time_s), 7, 10.0 * time_s, -4.0)
        for time_s in (1.0, 0.0)
    ]
    once = TruthState(at_ns(0.5), at_ns(0.5), 8, 0.0, 0.0)
    (path,) = true_paths([once, *twice])
    assert path.stamps_ns.tolist() == [at_ns(0.0), at_ns(1.0)]
    np.testing.assert_allclose(path(np.array([at_ns(0.25)])), [[2.5, -4.0]], atol=1e-9)
