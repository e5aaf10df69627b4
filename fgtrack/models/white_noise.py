"""Noise parameters of a motion model."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Self

from fgtrack.core.checks import not_negative, positive


@dataclass(frozen=True)
class WhiteNoise:
    """Noise parameters: spectral densities, in fields `<what>_density_<unit>` in the order of the state."""

    def __post_init__(self) -> None:
        not_negative(**{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def from_std_per_step(cls, std: Mapping[str, float], frequency_hz: float) -> Self:
        """Model as noisy as a filter that adds the variance (std / frequency_hz)^2 in each of its steps.

        Its densities are std^2 / frequency_hz. `std` is per second, as in Karle et al. 2023; its keys are the
        names of all densities up to `_density_`: `position`, `yaw`, `speed`, ... Raises `ValueError` when a
        key is missing or unknown or the frequency is not positive.
        """
        names = {name.partition("_density_")[0]: name for name in cls.density_names()}
        if set(std) != set(names):
            raise ValueError(f"std of {cls.__name__}: give {', '.join(names)}, not {', '.join(std) or 'nothing'}")
        positive(frequency_hz=frequency_hz)
        return cls(**{names[key]: value * value / frequency_hz for key, value in std.items()})

    @classmethod
    def density_names(cls) -> tuple[str, ...]:
        """Names of the density fields, in the order of the state."""
        return tuple(field.name for field in fields(cls) if "_density_" in field.name)
