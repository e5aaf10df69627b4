"""How a suite reports what is broken."""

from collections.abc import Callable, Mapping


class BrokenPromiseError(AssertionError):
    """A contract is broken: `promises` holds what is wrong by name of the promise."""

    def __init__(self, what: str, promises: Mapping[str, str]) -> None:
        super().__init__("\n\n".join(f"{what}: broken promise: it {name}\n{text}" for name, text in promises.items()))
        self.promises = dict(promises)


def run_all(what: str, checks: Mapping[str, Callable[[], None]]) -> None:
    """Run `checks`, each of which raises `BrokenPromiseError` of its own; raise one of all that is broken."""
    broken: dict[str, str] = {}
    for check in checks.values():
        try:
            check()
        except BrokenPromiseError as error:
            broken.update(error.promises)
    if broken:
        raise BrokenPromiseError(what, broken)
