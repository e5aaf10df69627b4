"""Public names of a package that are imported from their modules on first use."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module

Loader = Callable[[str], object]


def lazy_names(
    package: str, homes: Mapping[str, str]
) -> tuple[Loader, Callable[[], list[str]]]:
    """Return the functions `__getattr__` and `__dir__` of the module `package`.

    `homes` gives the module of each name, or the package if the name is a module.
    """
    members = vars(sys.modules[package])

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home = vars(import_module(homes[name]))
        value = home[name] if name in home else import_module(f"{homes[name]}.{name}")
        members[name] = value
        return value

    def names() -> list[str]:
        return sorted({*homes, *(each for each in members if each.startswith("__"))})

    return load, names
