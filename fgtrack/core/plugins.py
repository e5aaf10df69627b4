"""Parts by name: built-in ones, and those of installed packages (entry points), loaded on first use."""

import hashlib
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fgtrack.core.errors import CallError, FgtrackError, did_you_mean

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Alias:
    """Former name of a part."""

    name: str
    """Present name of the part."""
    note: str = ""
    """Sentence for whoever uses the former name."""


class Registry:
    """Parts of one kind by name: built-in ones, and entry points of the groups, loaded when their name is used.
    One with the name of a built-in part, or of an earlier plug-in, is left out with a warning.
    """

    def __init__(
        self,
        noun: str,
        built_in: Mapping[str, Mapping[str, str]],
        aliases: Mapping[str, Alias] | None = None,
    ) -> None:
        """`noun`: kind of the parts, for messages; `built_in`: `module:attribute` by name, for every entry-point group;
        `aliases`: by former names."""
        self._noun = noun
        self._built_in = built_in
        self._aliases = dict(aliases or {})

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def loaded(self, group: str | None = None) -> dict[str, Any]:  # Any: see `load`
        """All parts, or those of `group`, by name; a plug-in that cannot be loaded is left out with a warning."""
        parts = {}
        for name, entry in self._entries.items():
            if group in (None, entry.group):
                try:
                    parts[name] = self.load(name)
                except CallError as error:
                    _logger.warning("%s", error)
        return parts

    def sources(self) -> dict[str, str]:
        """Names of the plug-ins, with the package of each and a hash of the code of that package or module."""
        plugins = {
            name: entry
            for name, entry in self._entries.items()
            if entry.dist is not None
        }
        return {
            name: f"{_package(entry)} {_hash_of(entry)}"
            for name, entry in plugins.items()
        }

    def resolve(self, name: str) -> str:
        """Return the present name of the part `name`, with a warning for a former name.

        Raises `CallError` for an unknown name.
        """
        alias = self._aliases.get(name)
        if alias is not None:
            _logger.warning(
                "%s %r is now named %r. %s", self._noun, name, alias.name, alias.note
            )
            name = alias.name
        if name not in self._entries:
            hint = did_you_mean(name, [*self._entries, *self._aliases]).removesuffix(
                "?"
            )
            raise CallError(
                f"{self._noun} {name!r} is unknown{hint}: there are {', '.join(self)}"
            )
        return name

    def load(
        self, name: str
    ) -> Any:  # Any: what an entry point names is only known to its user
        """Return the part `name`. Raises `CallError` for an unknown name and a plug-in that cannot be loaded."""
        entry = self._entries[self.resolve(name)]
        with self.blamed(name, "cannot be loaded"):
            return entry.load()

    @contextmanager
    def blamed(self, name: str, what: str) -> Iterator[None]:
        """Exceptions in the block, unless raised on purpose or by built-in parts, become a `CallError` about `name`."""
        try:
            yield
        except FgtrackError:
            raise
        except (Exception, SystemExit) as error:  # of a foreign module: anything
            entry = self._entries.get(name)
            if entry is None or entry.dist is None:
                raise
            why = " ".join(f"{type(error).__name__}: {error}".split())
            raise CallError(
                f"{self._noun} {name!r}: plug-in {entry.value} of {_package(entry)} {what} ({why}): "
                "repair or uninstall it"
            ) from error

    @cached_property
    def _entries(self) -> dict[str, EntryPoint]:
        entries = {
            name: EntryPoint(name, value, group)
            for group, parts in self._built_in.items()
            for name, value in parts.items()
        }
        for group in self._built_in:
            for entry in sorted(
                entry_points(group=group),
                key=lambda entry: (entry.name, _package(entry)),
            ):
                alias = self._aliases.get(entry.name)
                holder = entries.setdefault(alias.name if alias else entry.name, entry)
                if (holder.value, _package(holder)) != (entry.value, _package(entry)):
                    _logger.warning(
                        "%s %r of %s is left out: the name belongs to %s; rename the entry point",
                        self._noun,
                        entry.name,
                        _package(entry),
                        _package(holder),
                    )
        return entries


def _package(entry: EntryPoint) -> str:
    return (
        "fgtrack" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
    )


def _hash_of(entry: EntryPoint) -> str:
    digest, spec = hashlib.sha256(), find_spec(entry.module.partition(".")[0])
    paths = (
        []
        if spec is None
        else [
            Path(each)
            for each in spec.submodule_search_locations or [spec.origin or ""]
        ]
    )
    for path in paths:
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes() if file.is_file() else b"")
    return digest.hexdigest()
