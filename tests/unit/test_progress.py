"""Progress of a long command: a bar in a terminal, ten lines in a log."""

import pytest

from fgtrack.cli.show import _duration, _logged, progress


@pytest.mark.parametrize(("total", "lines"), [(120, 10), (4, 4), (None, 0)])
def test_a_log_has_a_line_at_each_tenth(
    total: int | None, lines: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress("sweep", total) as moved:
        for _ in range(total or 20):
            moved()
    shown = capsys.readouterr().err.splitlines()
    assert len(shown) == lines
    if total is not None:
        assert shown[-1] == f"fgtrack: sweep: {total} of {total}"


def test_a_log_says_how_much_time_is_left(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = iter(30.0 * step for step in range(100))
    moved = _logged("sweep", 20, lambda: next(now_s))
    for _ in range(20):
        moved()
    shown = capsys.readouterr().err.splitlines()
    # The clock is read at the start, and then at every second step: 30 s for two steps.
    assert shown[0] == "fgtrack: sweep: 2 of 20, about 4 min left"
    assert shown[4] == "fgtrack: sweep: 10 of 20, about 2 min left"
    assert shown[-1] == "fgtrack: sweep: 20 of 20"


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "0 s"),
        (99.0, "99 s"),
        (101.0, "2 min"),
        (5940.0, "99 min"),
        (9000.0, "2 h 30 min"),
    ],
)
def test_a_duration_has_a_readable_unit(seconds: float, words: str) -> None:
    assert _duration(seconds) == words
