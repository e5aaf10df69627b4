"""Decides on clocks that differ by a known constant, and recognises recordings of a loop."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, EgoState, IntArray, Message
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.sample import Sample
from fgtrack.meaning.times import ClockConstant, clock_constant, loop_of

__all__ = ["clock_decisions"]

_EGO = "ego"
#: Fewest messages of a source for a judgement of its clock.
_FEWEST = 10


def clock_decisions(sample: Sample) -> Iterator[Decision]:
    """Yield a decision on each clock that differs by a known constant, and a question about a loop."""
    times = _times(sample.messages)
    constants = {
        name: constant
        for name, (stamps_ns, receipts_ns) in times.items()
        if len(stamps_ns) >= _FEWEST
        and sample.is_open(_key(name))
        and (constant := clock_constant((receipts_ns - stamps_ns) / NS_PER_S))
        is not None
    }
    for name, constant in constants.items():
        yield _constant(name, constant, times, constants)
    for name, (stamps_ns, receipts_ns) in times.items():
        loop = loop_of(stamps_ns, receipts_ns)
        if loop is not None:
            at_s = (receipts_ns[loop.index] - receipts_ns[0]) / NS_PER_S
            reason = (
                f"the stamps of {name} go back by {loop.back_s:.4g} s and repeat, {at_s:.4g} s after "
                "its first message: a recording was played in a loop"
            )
            question = f"which repetition counts? Cut the recording {at_s:.4g} s after its start"
            yield Decision("the recording", "time", {}, "open", reason, question)
            return


def _times(messages: Sequence[Message]) -> Mapping[str, tuple[IntArray, IntArray]]:
    """Return stamps and receipts, shape (n,) each, in the order of receipt, of the ego and of each sensor."""
    rows: dict[str, list[tuple[int, int]]] = {}
    for message in messages:
        if isinstance(message, EgoState):
            rows.setdefault(_EGO, []).append((message.stamp_ns, message.receipt_ns))
        elif isinstance(message, DetectionList):
            name = message.sensor
            rows.setdefault(name, []).append((message.stamp_ns, message.receipt_ns))
    tables = {name: np.array(each, dtype=np.int64) for name, each in rows.items()}
    return {name: (table[:, 0], table[:, 1]) for name, table in tables.items()}


def _key(name: str) -> tuple[str, ...]:
    section = ("ego",) if name == _EGO else ("sensors", name)
    return (*section, "clock_offset_s")


def _constant(
    name: str,
    constant: ClockConstant,
    times: Mapping[str, tuple[IntArray, IntArray]],
    constants: Mapping[str, ClockConstant],
) -> Decision:
    """Return the decision on one clock; the delays of other sources without a constant are the test."""
    others = [
        float(np.median(receipts_ns - stamps_ns)) / NS_PER_S
        for other, (stamps_ns, receipts_ns) in times.items()
        if other not in constants
    ]
    side = "ahead of" if constant.offset_s > 0.0 else "behind"
    reason = (
        f"stamps are {abs(constant.offset_s):g} s {side} the time of the recorder, "
        f"the difference of {constant.name}; the delay is then {1e3 * constant.delay_s:.0f} ms"
    )
    if others:
        reason += (
            f" ({', '.join(f'{1e3 * each:.0f}' for each in others)} ms for others)"
        )
    key = ".".join(_key(name))
    question = f"is its clock {constant.offset_s:g} s ahead? Else set {key} (0: the delay is real)"
    return Decision(
        name,
        "time",
        {_key(name): constant.offset_s},
        "tested" if others else "assumed",
        reason,
        None if others else question,
    )
