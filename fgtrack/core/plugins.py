"""Registry of parts by name: built-in parts, and plug-ins of installed packages (entry points)."""

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
    """Replacement for a former name of a part."""

    name: str
    """Present name of the part."""
    note: str = ""
    """Further sentence of the warning for a use of the former name."""


class Registry:
    """Parts of one kind by name: built-in parts and plug-ins (entry points), loaded at their first use.

    A plug-in whose name belongs to a built-in part or to an earlier plug-in is ignored with a warning.
    """

    def __init__(
        self,
        noun: str,
        built_in: Mapping[str, Mapping[str, str]],
        aliases: Mapping[str, Alias] | None = None,
    ) -> None:
        """Create the registry; plug-ins are searched at the first use.

        `noun` is the kind of the parts, for messages. `built_in` contains for every
        entry-point group the built-in parts as `module:attribute` by name. `aliases`
        contains present names by former names.
        """
        self._noun = noun
        self._built_in = built_in
        self._aliases = dict(aliases or {})

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def names(self, group: str | None = None) -> list[str]:
        """Names of all parts, or of the parts of one group of entry points."""
        return [
            name
            for name, entry in self._entries.items()
            if group in (None, entry.group)
        ]

    def loaded(self, group: str | None = None) -> dict[str, Any]:  # Any: see `load`
        """Return all parts, or the parts of `group`, by name.

        A plug-in that cannot be loaded is left out with a warning.
        """
        parts = {}
        for name, entry in self._entries.items():
            if group in (None, entry.group):
                try:
                    parts[name] = self.load(name)
                except CallError as error:
                    _logger.warning("%s", error)
        return parts

    def sources(self) -> dict[str, str]:
        """Return the package, its version and a hash of its source code for each plug-in, by the plug-in's name."""
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

    def load(self, name: str) -> Any:  # Any: an entry point may name any object
        """Return the part `name`; raises `CallError` for an unknown name and for a plug-in that cannot be loaded."""
        entry = self._entries[self.resolve(name)]
        with self.plugin_errors(name, "cannot be loaded"):
            return entry.load()

    @contextmanager
    def plugin_errors(self, name: str, what: str) -> Iterator[None]:
        """Turn an exception of the plug-in `name` in the block into a `CallError` that names the plug-in.

        `what` completes the message: "plug-in ... `what`". Exceptions of built-in parts
        and `FgtrackError` pass unchanged.
        """
        try:
            yield
        except FgtrackError:
            raise
        except (Exception, SystemExit) as error:  # a plug-in may raise anything
            entry = self._entries.get(name)
            if entry is None or entry.dist is None:
                raise
            why = " ".join(f"{type(error).__name__}: {error}".split())
            raise CallError(
                f"{self._noun} {name!r}: plug-in {entry.value} of {_package(entry)} {what} ({why}): "
                "repair or uninstall the package"
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
                        "%s %r of %s is not loaded: the name belongs to %s; rename the entry point",
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
    digest = hashlib.sha256()
    spec = find_spec(entry.module.partition(".")[0])
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
