"""Colours: by the name of an estimator, visible on white and dark pages."""

import pytest

from fgtrack.show.palette import PALETTE, SENSORS, style_of, styles


def luminance(colour: str) -> float:
    """Relative luminance as WCAG 2.1 defines it."""
    shares = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    r, g, b = (
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares
    )
    return 0.2126 * r + 0.7152 * g + 0.0722 * b


@pytest.mark.parametrize("page", ["#ffffff", "#14171b"])
def test_every_colour_is_visible_on_white_and_on_dark(page: str) -> None:
    for colour in (*PALETTE, *SENSORS):
        low, high = sorted((luminance(colour), luminance(page)))
        assert (high + 0.05) / (low + 0.05) >= 3.0, colour


def test_runs_of_one_estimator_share_the_colour_and_differ_by_the_line() -> None:
    found = styles(["smoother"] * 4)
    assert {one.colour for one in found} == {style_of("smoother").colour}
    assert len({one.line for one in found}) == 4
