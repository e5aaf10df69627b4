"""Draft of a recording's settings as a function: `fgtrack.draft`."""

from collections.abc import Mapping
from pathlib import Path

from fgtrack.config.reading import ConfigLike, read_config
from fgtrack.meaning.draft import Draft, drafted


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
