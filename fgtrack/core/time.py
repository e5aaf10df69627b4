"""Integer nanoseconds and float seconds; the only place where one becomes the other."""

NS_PER_S = 1_000_000_000


def seconds(duration_ns: int) -> float:
    """Duration in seconds of `duration_ns` (a difference of stamps, never an epoch stamp)."""
    return duration_ns / NS_PER_S


def nanoseconds(duration_s: float) -> int:
    """Duration in integer nanoseconds, rounded to the nearest."""
    return round(duration_s * NS_PER_S)


def period_ns(frequency_hz: float) -> int:
    """Period of `frequency_hz` in integer nanoseconds, truncated as clocks are."""
    return int(NS_PER_S / frequency_hz)


def first_multiple(stamp_ns: int, step_ns: int) -> int:
    """Smallest multiple of `step_ns` that is not before `stamp_ns`."""
    return -(-stamp_ns // step_ns) * step_ns
