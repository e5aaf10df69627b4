"""The installed command: an interrupt while it loads, and that it runs the command line."""

import sys

import pytest

from fgtrack.cli import entry


class Interrupted:
    """Ctrl-C while a package loads."""

    def find_spec(self, name: str, *rest: object) -> None:
        if name == "fgtrack.cli.main":
            raise KeyboardInterrupt


def test_an_interrupt_while_loading_is_one_line(monkeypatch, capsys) -> None:
    monkeypatch.delitem(sys.modules, "fgtrack.cli.main", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    with pytest.raises(SystemExit) as left:
        entry.main()
    assert left.value.code == 130
    assert capsys.readouterr().err == "fgtrack: error: interrupted\n"


def test_it_runs_the_command_line(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["fgtrack", "--version"])
    with pytest.raises(SystemExit) as left:
        entry.main()
    assert left.value.code == 0
    assert capsys.readouterr().out.startswith("fgtrack ")
