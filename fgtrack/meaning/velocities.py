"""Tests what a reported velocity means, against the successive positions of the same objects."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.meaning.decision import Certainty
from fgtrack.meaning.motions import Motions

__all__ = ["SPEED_UNITS", "VelocityKind", "VelocityMeaning", "by_name", "meaning_of"]

VelocityKind = Literal[
    "absolute",
    "relative",
    "radial",
    "radial over ground",
    "relative speed",
    "along x",
    "relative along x",
]
"""Meaning of a velocity. The first three can be used; the other ones are recognised and left out."""

#: Component of a detection by kind; the other kinds are not used.
_COMPONENTS: Mapping[VelocityKind, str] = {
    "absolute": "speed_mps",
    "relative": "range_rate_mps",
    "radial": "range_rate_mps",
}
#: Factor to m/s by unit.
SPEED_UNITS = {
    "m/s": 1.0,
    "km/h": 1.0 / 3.6,
    "knots": 0.514444,
    "mph": 0.44704,
    "cm/s": 0.01,
}
_RELATIVE = frozenset(("relative", "rel", "vrel", "closing", "approach", "approaching"))
_RADIAL = frozenset(
    ("doppler", "radial", "rdot", "rangerate", "rate", "vr", "rr", "closing")
)
_OVER_GROUND = frozenset(("compensated", "comp", "corrected", "abs", "absolute"))
_COMPONENT = frozenset(("x", "long", "longitudinal", "lon"))
#: Fewest straight paths for a test.
_FEWEST = 8
#: A hypothesis is refuted if it differs by more than the largest of these: a velocity, standard deviations of the
#: velocity from positions, and a share of the typical velocity.
_TOLERANCE_MPS = 0.5
_TOLERANCE_STD = 2.5
_TOLERANCE_SHARE = 0.15
#: Two hypotheses are ambiguous if their differences are within this factor and this velocity.
_LIKE_FACTOR = 1.5
_LIKE_MPS = 0.2
#: Quantile of the differences by which hypotheses are compared. A median ignores the half of the objects for which two
#: hypotheses differ.
_QUANTILE = 0.8


@dataclass(frozen=True)
class VelocityMeaning:
    """Meaning of the raw values of a velocity: one speed, or two components along the axes of the positions."""

    kind: VelocityKind | None
    """None if no hypothesis agrees with the positions."""
    unit: str
    """Unit of the raw values, a key of `SPEED_UNITS`."""
    sign: float
    """-1 if positive values mean that the object comes closer, else 1."""
    certainty: Certainty
    """`assumed` if the best hypotheses are ambiguous, or positions are too few; `open` if none agrees."""
    misfit_mps: float
    """Difference from the motion between successive positions that 80 % stay below; NaN without a test."""
    reason: str
    """Result of the test in words."""

    @property
    def component(self) -> str | None:
        """Name of the component of a detection that takes these values; None if no component takes them."""
        return None if self.kind is None else _COMPONENTS.get(self.kind)

    @property
    def scale(self) -> float:
        """Factor from the raw values to m/s, with the sign."""
        return self.sign * SPEED_UNITS[self.unit]


@dataclass(frozen=True)
class _Fit:
    kind: VelocityKind
    unit: str
    sign: float
    misfit_mps: float
    typical_mps: float


def by_name(names: Sequence[Sequence[str]]) -> list[VelocityKind]:
    """Return the kinds in the order in which the words of the fields' names suggest them.

    `names` contains the words of each field: one for a speed, two for components x and
    y.
    """
    words = {word for each in names for word in each}
    likely: list[VelocityKind] = []
    over_ground = bool(words & _OVER_GROUND)
    if words & _RADIAL:
        likely.append("radial over ground" if over_ground else "radial")
    if words & _RELATIVE and not over_ground:
        if len(names) == 2:
            likely.append("relative")
        elif words & _COMPONENT:
            likely.append("relative along x")
        else:
            likely += ["radial", "relative speed"]
    rest: list[VelocityKind] = ["absolute", "relative", "radial", "radial over ground"]
    if len(names) == 1:
        rest = ["absolute", "radial", "radial over ground", "relative speed"]
        rest += ["along x", "relative along x"]
    return list(dict.fromkeys([*likely, *rest]))


def meaning_of(
    motions: Motions, order: Sequence[VelocityKind], unit: str | None = None
) -> VelocityMeaning:
    """Return the kind, unit and sign that agree best with the positions.

    `order` contains the kinds, the most probable one first. `unit` is the unit in the
    name of the field. Another unit, or a sign of -1 for a kind other than `radial`, must
    halve the misfit.
    """
    known = np.asarray(np.isfinite(motions.values).all(axis=1))
    if known.sum() < _FEWEST:
        text = f"{int(known.sum())} objects with successive positions are too few for a test"
        return VelocityMeaning(
            order[0], unit or "m/s", 1.0, "assumed", math.nan, f"by its name; {text}"
        )
    fits = sorted(
        (fit for kind in order for fit in _fits(motions, kind, known, unit)),
        key=lambda fit: fit.misfit_mps,
    )
    best = fits[0]
    limit_mps = max(
        _TOLERANCE_MPS,
        _TOLERANCE_STD * motions.std_mps,
        _TOLERANCE_SHARE * best.typical_mps,
    )
    if best.misfit_mps > limit_mps:
        text = (
            f"no meaning agrees with successive positions: as {best.kind} it differs "
            f"by up to {best.misfit_mps:.2g} m/s"
        )
        return VelocityMeaning(None, unit or "m/s", 1.0, "open", best.misfit_mps, text)
    like = [
        fit
        for fit in fits
        if fit.misfit_mps <= _LIKE_FACTOR * best.misfit_mps + _LIKE_MPS
    ]
    chosen = min(like, key=lambda fit: (order.index(fit.kind), fit.misfit_mps))
    component = _COMPONENTS.get(chosen.kind)
    others = [fit for fit in fits if _COMPONENTS.get(fit.kind) != component]
    rival = others[0] if others else None
    if rival is not None and rival in like:
        text = (
            f"as {chosen.kind} in {chosen.unit} it differs from successive positions by up to "
            f"{chosen.misfit_mps:.2g} m/s, as {rival.kind} by {rival.misfit_mps:.2g} m/s"
        )
        certainty: Certainty = "assumed"
    else:
        more = "" if rival is None else f", as {rival.kind} by {rival.misfit_mps:.2g}"
        text = (
            f"{chosen.kind} in {chosen.unit}: differs from successive positions of {int(known.sum())} "
            f"stretches by up to {chosen.misfit_mps:.2g} m/s{more}"
        )
        certainty = "tested"
    return VelocityMeaning(
        chosen.kind, chosen.unit, chosen.sign, certainty, chosen.misfit_mps, text
    )


def _fits(
    motions: Motions, kind: VelocityKind, known: BoolArray, unit: str | None
) -> Iterator[_Fit]:
    """Yield the best fit of `kind`, with its unit and sign; none for values of another shape."""
    pairs = list(_pairs(motions, kind))
    if not pairs:
        return
    given = unit or "m/s"
    fits = []
    for raw, truth in pairs:
        typical_mps = float(np.median(np.linalg.norm(truth[known], axis=1)))
        for name, scale in SPEED_UNITS.items():
            for sign in (1.0, -1.0):
                rest = sign * scale * raw[known] - truth[known]
                misfit_mps = float(np.quantile(np.linalg.norm(rest, axis=1), _QUANTILE))
                fits.append(_Fit(kind, name, sign, misfit_mps, typical_mps))

    def penalised(fit: _Fit) -> float:
        is_other = fit.unit != given or (fit.sign < 0.0 and kind != "radial")
        return (fit.misfit_mps + _LIKE_MPS) * (2.0 if is_other else 1.0)

    yield min(fits, key=penalised)


def _pairs(
    motions: Motions, kind: VelocityKind
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield raw values and the velocities that `kind` expects for them, both of shape (m, d)."""
    values = motions.values
    if values.shape[1] == 2:
        along = motions.values_along_sight[:, None]
        if kind == "absolute":
            yield values, motions.in_frame_mps
            yield values, motions.in_map_mps
        elif kind == "relative":
            yield values, motions.relative_mps
            yield values, motions.apparent_mps
        elif kind in ("radial", "radial over ground"):
            # The vector points along the line of sight; across, it is 0.
            across = np.sqrt(
                np.maximum(np.square(values).sum(axis=1) - along[:, 0] ** 2, 0.0)
            )
            truth = (
                motions.radial_mps if kind == "radial" else motions.radial_in_map_mps
            )
            yield (
                np.column_stack([along[:, 0], across]),
                np.column_stack([truth, 0.0 * truth]),
            )
        return
    expected = {
        "absolute": np.hypot(*motions.in_map_mps.T),
        "radial": motions.radial_mps,
        "radial over ground": motions.radial_in_map_mps,
        "relative speed": np.hypot(*motions.relative_mps.T),
        "along x": motions.in_frame_mps[:, 0],
        "relative along x": motions.relative_mps[:, 0],
    }
    if kind in expected:
        yield values, expected[kind][:, None]
