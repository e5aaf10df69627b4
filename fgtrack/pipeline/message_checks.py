"""Checks of received messages, and the numbers of refused messages by reason."""

from collections import Counter
from dataclasses import replace
from operator import index as integer
from typing import ClassVar

from fgtrack.config.settings import Config
from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.state import Stateful
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    UpdateRecord,
)
from fgtrack.inputs.validation import (
    InvalidMessageError,
    validated_detection,
    validated_head,
)

__all__ = ["MessageChecks", "unreadable"]

#: Number of unknown sensors that are counted by name; further unknown sensors are counted as `OTHERS`.
MOST_UNKNOWN = 100
OTHERS = "other sensors"


class MessageChecks(Stateful):
    """Checks of received messages against a configuration, with counts of what was refused."""

    STATE: ClassVar[tuple[str, ...]] = ("refused", "_unknown")

    def __init__(self, config: Config) -> None:
        self._config = config
        self.refused: Counter[str] = Counter()
        """Numbers of messages, detections and ticks that were not used, by reason."""
        # Unknown sensors that are counted by name, in order of their first messages.
        self._unknown: dict[str, None] = {}

    def checked(
        self, message: EgoState | DetectionList
    ) -> tuple[list[EgoState | DetectionList], list[UpdateRecord]]:
        """Return the valid message, if it is one, and the records of its detections if it is refused."""
        try:
            return self._valid(message), []
        except InvalidMessageError as error:
            is_list = isinstance(message, DetectionList)
            kind = "object list" if is_list else "ego state"
            return [], self.refuse(message, f"{kind}: {_rule(error)}")
        except _RefusedError as error:
            return [], self.refuse(message, str(error))
        except Exception as error:
            return [], self.refuse(message, unreadable(error))

    def refuse(
        self, message: EgoState | DetectionList, reason: str
    ) -> list[UpdateRecord]:
        """Count a message that is not used; return the records of its detections, which are invalid."""
        self.refused[reason] += 1
        if not isinstance(message, DetectionList):
            return []
        sensor = message.sensor if isinstance(message.sensor, str) else OTHERS
        times_ns = _recorded_ns(message.stamp_ns), _recorded_ns(message.receipt_ns)
        return [
            UpdateRecord(sensor, *times_ns, row, Disposition.INVALID)
            for row in range(len(message.objects))
        ]

    def name_for_counts(self, sensor: str) -> str:
        """Return the name under which a sensor is counted: unknown sensors beyond the first 100 share a name."""
        if sensor in self._config.sensors or sensor in self._unknown:
            return sensor
        if len(self._unknown) == MOST_UNKNOWN:
            return OTHERS
        self._unknown[sensor] = None
        return sensor

    def _valid(
        self, message: EgoState | DetectionList
    ) -> list[EgoState | DetectionList]:
        """Return the valid message; nothing of an ignored sensor. Raises for other messages."""
        if not isinstance(message, EgoState | DetectionList):
            raise _RefusedError("neither ego state nor object list")
        message = validated_head(message)
        for name in ("stamp_ns", "receipt_ns"):
            if not 0 <= getattr(message, name) <= LARGEST_NS:
                raise InvalidMessageError(f"{name}: nanoseconds since 1970 expected")
        if isinstance(message, EgoState):
            return [message]
        if message.sensor not in self._config.sensors:
            if message.sensor in self._config.ignore_sensors:
                return []
            name = self.name_for_counts(message.sensor)
            raise _RefusedError(f"sensor {name!r} has no model")
        objects = tuple(map(self._valid_detection, message.objects))
        return [replace(message, objects=objects)]

    def _valid_detection(self, item: Detection) -> Detection:
        """Return `item` with plain values; a detection without values if it has wrong types."""
        try:
            return validated_detection(item)
        except InvalidMessageError as error:
            self.refused[f"detection: {_rule(error)}"] += 1
            return Detection()


class _RefusedError(Exception):
    """A message that is not used, with the reason."""


def _rule(error: InvalidMessageError) -> str:
    """Return the expected value in the message of `error`, without the given value, so that reasons can be counted."""
    return str(error).partition(", not ")[0]


def unreadable(error: Exception) -> str:
    """Return the reason why a message is not used that raised `error`."""
    return f"message cannot be read ({type(error).__name__})"


def _recorded_ns(value: object) -> int:
    """Return a time of a refused message for its records; 0 if it is not an integer."""
    try:
        return integer(value)  # type: ignore[arg-type]  # any received object
    except Exception:
        return 0
