"""A filter without a withdrawn measurement is that which never had it."""

import numpy as np
import pytest

from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.filters.replay_bank import ReplayBank
from fgtrack.models.motion import CT, CTRV, CV, WhiteNoise

SECOND = 1_000_000_000


def fused(motion: WhiteNoise, left_out: int | None = None) -> ReplayBank:
    """Return a bank of one track that has fused ten positions in disorder, all but one."""
    bank, rng = ReplayBank(motion, 10.0), np.random.default_rng(5)
    bank.advance(SECOND)
    bank.birth(7, Start(stamp_ns=0, yaw_rad=0.3, speed_mps=8.0))
    for k, one in enumerate(positions(rng)):
        if k != left_out:
            bank.update(one.stamp_ns, [7], [one])
    return bank


def positions(rng: np.random.Generator) -> list[Measurement]:
    """Return ten positions of a moving object in disorder."""
    order = rng.permutation(10)
    return [
        Measurement.of(
            int(k) * SECOND // 10 + 1,
            std=0.4,
            x_m=0.8 * k + rng.normal(0.0, 0.4),
            y_m=0.1 * k + rng.normal(0.0, 0.4),
        )
        for k in order
    ]


@pytest.mark.parametrize("motion", [CV(), CT(), CTRV()])
@pytest.mark.parametrize("index", [0, 4, 9])
def test_a_withdrawn_measurement_was_never_fused(
    motion: WhiteNoise, index: int
) -> None:
    bank, expected = fused(motion), fused(motion, left_out=index)
    one = positions(np.random.default_rng(5))[index]
    assert bank.has_fused(7, one)
    assert bank.withdraw(7, one)
    assert not bank.has_fused(7, one)
    for stamp_ns in (SECOND // 2, SECOND):
        own, other = bank.states_at(stamp_ns), expected.states_at(stamp_ns)
        assert (own.means == other.means).all()
        assert (own.covariances == other.covariances).all()
    again = bank.update(one.stamp_ns, [7], [one])
    assert again[0].nis is not None
    whole = fused(motion)
    np.testing.assert_allclose(
        bank.states_at(SECOND).means, whole.states_at(SECOND).means, rtol=1e-12
    )


def test_a_measurement_that_was_never_fused_cannot_be_withdrawn() -> None:
    bank = fused(CV(), left_out=3)
    before = bank.states_at(SECOND).means
    assert not bank.withdraw(7, positions(np.random.default_rng(5))[3])
    assert (bank.states_at(SECOND).means == before).all()
