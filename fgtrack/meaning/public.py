"""Meaning of a recording as functions: `fgtrack.draft` and `fgtrack.mounts`."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.meaning.draft import Draft, drafted, opened
from fgtrack.meaning.input_checks import messages_within
from fgtrack.meaning.mounts import Mounts
from fgtrack.meaning.placement import mounts_of
from fgtrack.meaning.sample import SAMPLE_S


def draft(
    recording: str | Path,
    config: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
) -> Draft:
    """Return the meaning of a recording's numbers: decisions with their certainty, settings, and open questions.

    `fgtrack.replay` and `fgtrack.study` use the same settings: `draft.config`. Settings
    that are given by `config`, `map`, `pit_map` and `set` (as in `fgtrack.replay`) stay.
    `draft.decisions` are tested, assumed or open. `draft.questions` are the questions
    that the recording does not answer, a line each with the key to set.
    `draft.to_yaml()` is a configuration with the reasons as comments.

    Raises `CallError` for an invalid configuration, and `DataError` for a recording that
    cannot be read.
    """
    return drafted(recording, read_config(config, set, track_map=map, pit_map=pit_map))


def mounts(
    recording: str | Path | Iterable[Message],
    config: ConfigLike | None = None,
    *,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
) -> Mounts:
    """Estimate yaw and lever arm of each sensor in the ego, with 95 % intervals, from the first two minutes.

    `mounts["radar"]` has `yaw_rad`, `x_m`, `y_m`, their `half_widths`, and `is_off`: true
    if the mount differs significantly from the one in `config` (or from the origin of
    the ego). The mounts are relative to a reference sensor, whose own mount is assumed
    unless objects that stand still show it. `print` gives the result in words.
    `recording` is a path, or messages in the order of their receipt.

    Raises `CallError` for an invalid configuration, and `DataError` for a recording that
    cannot be read.
    """
    resolved = read_config(config, set)
    messages: Iterable[Message]
    if isinstance(recording, str | Path):
        draft = opened(recording, resolved)
        resolved = draft.config
        messages = UntilBreak(draft.source.messages())
    else:
        messages = recording
    first = list(messages_within(messages, nanoseconds(SAMPLE_S)))
    return mounts_of(first, resolved)
