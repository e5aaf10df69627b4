"""Entry point: runs a command and turns what went wrong into one line and an exit code."""

import ast
import logging
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import fgtrack
from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.io.output import FULL

DONE, BAD_DATA, BAD_CALL, INTERRUPTED = 0, 1, 2, 130

#: Commands in the order of the help; each is a function in the module of its name.
COMMANDS = (
    *("demo", "simulate", "replay", "compare", "figure", "report", "export", "sweep"),
    *("tune", "advise", "verify", "info", "convert", "offsets", "config"),
)
_STYLE: dict[str, Any] = {"add_completion": False, "rich_markup_mode": None, "pretty_exceptions_enable": False}


class _LazyCommands(TyperGroup):
    """Imports a command's module when the command is called; the help needs none of them."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else _command(name), rest


def _command(name: str) -> Any:  # Any: Typer does not export the type of its commands
    single = typer.Typer(**_STYLE)
    single.command(name)(getattr(import_module(f"fgtrack.cli.{name}"), name))
    return typer.main.get_command(single)


def _help(name: str) -> str:
    """Docstring of a command, read from its source."""
    module = ast.parse(Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8"))
    functions = [item for item in module.body if isinstance(item, ast.FunctionDef) and item.name == name]
    return ast.get_docstring(functions[0]) or ""


app = typer.Typer(
    name="fgtrack",
    cls=_LazyCommands,
    help="Track objects from delayed object lists, and compare how delays are dealt with.",
    **{**_STYLE, "add_completion": True},
)
for _name in COMMANDS:
    app.command(_name, help=_help(_name))(lambda: None)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"fgtrack {fgtrack.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options before the command; `main` reads --debug itself."""


class _OneLine(logging.Formatter):
    """Warnings of readers name what is in files."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`; as a terminal can show it."""
        return one_line(super().format(record))


def run(arguments: Sequence[str]) -> int:
    """Run one command; gives the exit code. Errors are one line on stderr."""
    debug = "--debug" in arguments
    words = [word for word in arguments if word != "--debug"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # not every terminal knows every letter
            stream.reconfigure(errors="backslashreplace")
    logged = logging.StreamHandler()
    logged.setFormatter(_OneLine("fgtrack: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[logged], force=True)
    try:
        outcome = typer.main.get_command(app).main(words or ["--help"], prog_name="fgtrack", standalone_mode=False)
        if outcome == INTERRUPTED:  # typer turns the exception into this code
            return _failed("interrupted; what was computed so far is in the output folder", INTERRUPTED, debug)
        sys.stdout.flush()
        return BAD_CALL if not words else outcome if isinstance(outcome, int) else DONE
    except typer.TyperException as error:
        return _failed(error.format_message(), BAD_CALL, debug)
    except CallError as error:
        return _failed(str(error), BAD_CALL, debug)
    except FgtrackError as error:
        return _failed(str(error), BAD_DATA, debug)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of a pipe has left: not an error worth a line
        return DONE
    except OSError as error:  # of files, the library makes its own errors
        if error.errno in FULL:
            what = f"what was to be printed cannot be written ({error.strerror}), free some space"
            return _failed(what, BAD_DATA, debug)
        if error.filename is not None:  # of a path that was given, there or in a file
            return _failed(f"{error.filename}: cannot be used, the system says: {error.strerror}", BAD_CALL, debug)
        return _bug(error, debug)
    except Exception as error:  # the last line of defence: a bug must not look like bad data
        return _bug(error, debug)


def _bug(error: Exception, debug: bool) -> int:
    return _failed(f"internal error: {type(error).__name__}: {error} (run with --debug)", BAD_DATA, debug)


def _failed(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"fgtrack: error: {one_line(message)}", file=sys.stderr)
    return code


def main() -> None:
    """Run the command line and exit."""
    sys.exit(run(sys.argv[1:]))
