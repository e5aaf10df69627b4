"""Integer nanoseconds and float seconds; the only conversion between the two."""

NS_PER_S = 1_000_000_000
NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1000, "ns": 1}
_EPOCH_S = (1e9, 4e9)  # the years 2001 to 2096, in seconds since 1970
_MOST_HZ = (
    1e5,
    1e4,
)  # of one source, and where the magnitude is that of another unit too; an inertial unit has 1e4
_LONGEST_S = 10 * 365.25 * 86400.0
_FEWEST = 10  # times that have a rate


def epoch_unit(value: float) -> str | None:
    """Unit in which `value` is a time of the years 2001 to 2096; None where it is in none."""
    return next(
        (
            unit
            for unit, ns in NS_PER_UNIT.items()
            if _EPOCH_S[0] <= value * ns / NS_PER_S < _EPOCH_S[1]
        ),
        None,
    )


def wrong_unit(count: int, first_ns: int, last_ns: int, unit: str = "ns") -> str | None:
    """Sentence about `count` times of one source, read in `unit`, that no recording has; None of plausible ones."""
    duration_s = seconds(last_ns - first_ns)
    likely = epoch_unit(last_ns / NS_PER_UNIT[unit])
    is_other = likely not in (None, unit)
    if (
        count >= _FEWEST
        and count - 1 > _MOST_HZ[is_other] * duration_s
        and (is_other or duration_s > 0.0)
    ):
        looks = f", they look like {likely} since 1970" if is_other else ""
        return f"{count} times within {duration_s:.3g} s, which no sensor sends: they are not in {unit}{looks}"
    if duration_s > _LONGEST_S:
        years = duration_s / (365.25 * 86400.0)
        return f"is {years:.3g} years long: its times are of several units or clocks (`time_unit` of CSV tables)"
    return None


def seconds(duration_ns: int) -> float:
    """Duration in seconds of `duration_ns` (a difference of stamps, never an epoch stamp)."""
    return duration_ns / NS_PER_S


def nanoseconds(duration_s: float) -> int:
    """Duration in integer nanoseconds, rounded to the nearest."""
    return round(duration_s * NS_PER_S)


def period_ns(frequency_hz: float) -> int:
    """Period of `frequency_hz` in integer nanoseconds, truncated as clocks are."""
    return int(NS_PER_S / frequency_hz)
