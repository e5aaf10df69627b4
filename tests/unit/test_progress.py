"""Progress of a long command: a bar in a terminal, ten lines in a log."""

import pytest

from fgtrack.cli.show import progress


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
