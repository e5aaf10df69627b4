import pytest
from support.tracking import START_NS, ms

from fgtrack.core.errors import DataError
from fgtrack.core.types import EgoState
from fgtrack.pipeline.ego_clock import EgoClock


def states(offsets_ms: list[float], period_ms: float = 50.0) -> list[EgoState]:
    """One state every period; its stamp is off by its entry."""
    return [
        EgoState(START_NS + ms(i * period_ms + offset), START_NS + ms(i * period_ms), 0.0, 0.0, 0.0, 10.0)
        for i, offset in enumerate(offsets_ms)
    ]


def check(offsets_ms: list[float], **more: float) -> None:
    clock = EgoClock()
    for state in states(offsets_ms, **more):
        clock.check(state)


@pytest.mark.parametrize("jump_ms", [60_000.0, -60_000.0, 3.6e6, 1_500.0, -1_500.0])
def test_a_stray_stamp_is_nothing(jump_ms: float) -> None:
    check([0.0] * 10 + [jump_ms] + [0.0] * 40 + [jump_ms] * 5 + [0.0] * 40)


@pytest.mark.parametrize(
    ("jump_ms", "said"), [(3.6e6, "jump ahead by 3600 s at receipt"), (-5_000.0, "jump back by 4.95 s at receipt")]
)
def test_a_jump_that_lasts_ends_the_recording_and_says_where_it_began(jump_ms: float, said: str) -> None:
    with pytest.raises(DataError) as caught:
        check([0.0] * 10 + [jump_ms] * 30)
    assert f"{said} {START_NS + ms(500.0)} ns and stay there" in str(caught.value)


def test_a_slow_localisation_jumps_after_three_states() -> None:
    check([0.0, 0.0, 60_000.0, 60_000.0], period_ms=2000.0)
    with pytest.raises(DataError, match="jump ahead"):
        check([0.0, 0.0, 60_000.0, 60_000.0, 60_000.0], period_ms=2000.0)


@pytest.mark.parametrize("jump_ms", [60_000.0, -60_000.0, 5_000.0])
def test_a_stray_stamp_at_the_beginning_is_nothing(jump_ms: float) -> None:
    check([jump_ms] + [0.0] * 100)
