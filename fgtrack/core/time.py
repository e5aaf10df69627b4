"""Times: the only conversion between integer nanoseconds and float seconds, and checks of their unit."""

NS_PER_S = 1_000_000_000
NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1000, "ns": 1}
#: The years 2001 to 2096, in seconds since 1970.
_EPOCH_S = (1e9, 4e9)
#: Highest plausible rate of a source; the lower one applies if the magnitude suggests another unit. An IMU has 1e4 Hz.
_MOST_HZ = (1e5, 1e4)
#: Longest plausible recording: ten years.
_LONGEST_S = 10 * 365.25 * 86400.0
#: Fewest times from which a rate is computed.
_FEWEST = 10


def epoch_unit(value: float) -> str | None:
    """Return the unit (`s`, `ms`, `us`, `ns`) in which `value` is a time in the years 2001 to 2096, or None."""
    return next(
        (
            unit
            for unit, ns in NS_PER_UNIT.items()
            if _EPOCH_S[0] <= value * ns / NS_PER_S < _EPOCH_S[1]
        ),
        None,
    )


def wrong_unit(count: int, first_ns: int, last_ns: int, unit: str = "ns") -> str | None:
    """Sentence that `count` times of one source, read in `unit`, are implausible; None if they are plausible.

    Too high a rate and too long a duration are implausible.
    """
    duration_s = seconds(last_ns - first_ns)
    likely = epoch_unit(last_ns / NS_PER_UNIT[unit])
    is_other = likely not in (None, unit)
    if (
        count >= _FEWEST
        and count - 1 > _MOST_HZ[is_other] * duration_s
        and (is_other or duration_s > 0.0)
    ):
        hint = f", but probably in {likely} since 1970" if is_other else ""
        return f"{count} times within {duration_s:.3g} s, which no sensor sends: they are not in {unit}{hint}"
    if duration_s > _LONGEST_S:
        years = duration_s / (365.25 * 86400.0)
        return (
            f"is {years:.3g} years long: its times have several units or clocks, "
            "set `time_unit` of a CSV table or correct the clock"
        )
    return None


def seconds(duration_ns: int) -> float:
    """Convert a duration, a difference of stamps, from integer nanoseconds to seconds.

    An epoch stamp must not be converted: a float does not hold its nanoseconds.
    """
    return duration_ns / NS_PER_S


def nanoseconds(duration_s: float) -> int:
    """Convert a duration from seconds to integer nanoseconds, rounded to the nearest."""
    return round(duration_s * NS_PER_S)


def period_ns(frequency_hz: float) -> int:
    """Period of `frequency_hz` in integer nanoseconds, truncated."""
    return int(NS_PER_S / frequency_hz)
