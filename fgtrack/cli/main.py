"""Entry point: runs a command and turns what went wrong into one line and an exit code."""

import logging
import os
import resource
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from inspect import cleandoc
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

import fgtrack
from fgtrack.cli.exit_codes import BAD_CALL, BAD_DATA, DONE, INTERRUPTED
from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.core.output import FULL

#: Commands in the order of the help, functions of that name, and the modules that hold them.
COMMANDS = {
    "demo": "study",
    "study": "study",
    "simulate": "recordings",
    "replay": "replay",
    "compare": "runs",
    "figure": "pictures",
    "report": "pictures",
    "export": "runs",
    "sweep": "sweep",
    "tune": "tune",
    "advise": "calibrate",
    "ledger": "ledger",
    "verify": "verify",
    "info": "calibrate",
    "convert": "recordings",
    "offsets": "calibrate",
    "config": "recordings",
}
_STYLE: dict[str, Any] = {
    "add_completion": False,
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
}


class _LazyCommands(TyperGroup):
    """Imports a command's module when the command is called; the help needs none of them."""

    def resolve_command(
        self, ctx: Any, args: list[str]
    ) -> tuple[str | None, Any, list[str]]:
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else _command(name), rest


def _command(name: str) -> Any:  # Any: Typer does not export the type of its commands
    single = typer.Typer(**_STYLE)
    single.command(name)(getattr(import_module(f"fgtrack.cli.{COMMANDS[name]}"), name))
    return typer.main.get_command(single)


app = typer.Typer(
    name="fgtrack",
    cls=_LazyCommands,
    help="Track objects from delayed object lists, and compare how delays are dealt with.",
    epilog="Exit codes: 0 done, 1 bad data or run, 2 bad call.",
    **{**_STYLE, "add_completion": True},
)


def _help(name: str) -> str:
    """Docstring of a command, read from its source."""
    source = (
        Path(__file__).with_name(f"{COMMANDS[name]}.py").read_text(encoding="utf-8")
    )
    return cleandoc(source.partition(f"\ndef {name}(")[2].split('"""')[1])


for _name in COMMANDS:
    app.command(_name, help=_help(_name))(lambda: None)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"fgtrack {fgtrack.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[
        bool, Option("--debug", help="Show the traceback of an error.")
    ] = False,
    version: Annotated[
        bool,
        Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
    max_memory_gb: Annotated[
        float,
        Option("--max-memory", min=0.0, metavar="GIB", help="Most memory; 0: all."),
    ] = 4.0,
) -> None:
    """Options before the command; `main` reads --debug itself."""
    if (
        max_memory_gb and sys.platform == "linux"
    ):  # elsewhere the system does not hold to it
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        limit = int(max_memory_gb * 2**30)
        resource.setrlimit(
            resource.RLIMIT_AS,
            (limit if most == resource.RLIM_INFINITY else min(limit, most), most),
        )


class _OneLine(logging.Formatter):
    """Warnings of readers, libraries and plug-ins contain names from files."""

    def format(self, record: logging.LogRecord) -> str:
        """See `logging.Formatter.format`; as a terminal can show it."""
        return one_line(super().format(record))


def run(arguments: Sequence[str]) -> int:
    """Run one command; gives the exit code. Errors are one line on stderr."""
    debug = "--debug" in arguments
    words = [word for word in arguments if word != "--debug"]
    memory = resource.getrlimit(resource.RLIMIT_AS)
    logged = logging.StreamHandler()
    logged.setFormatter(_OneLine("fgtrack: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[logged], force=True)
    logging.getLogger("matplotlib").setLevel(
        logging.ERROR
    )  # figures need nothing of what it looks for in the system
    logging.captureWarnings(True)
    try:
        return _run(words, debug)
    finally:
        logging.captureWarnings(False)
        resource.setrlimit(
            resource.RLIMIT_AS, memory
        )  # of whoever calls this from Python


def _run(words: Sequence[str], debug: bool) -> int:
    try:
        outcome = typer.main.get_command(app).main(
            [*words] or ["--help"], prog_name="fgtrack", standalone_mode=False
        )
        if outcome == INTERRUPTED:  # typer turns the exception into this code
            return _failed(
                "interrupted; what was computed so far is in the output folder",
                INTERRUPTED,
                debug,
            )
        return BAD_CALL if not words else outcome if isinstance(outcome, int) else DONE
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        usage = (
            ""
            if context is None
            else f" ({context.get_usage().replace('Usage:', 'usage:')})"
        )
        return _failed(f"{error.format_message()}{usage}", BAD_CALL, debug)
    except FgtrackError as error:
        return _failed(
            str(error), BAD_CALL if isinstance(error, CallError) else BAD_DATA, debug
        )
    except MemoryError:
        return _failed(
            "more memory needed than --max-memory allows: raise it, or split the input",
            BAD_DATA,
            debug,
        )
    except (
        OSError
    ) as error:  # of a path that was given, there or in a file, else of stdout
        code = BAD_DATA if error.errno in FULL else BAD_CALL
        if error.filename is None:
            sys.stdout = None  # so that the end of the process does not fail on it, too
        return _failed(
            f"{error.filename or 'standard output'}: cannot be used ({error.strerror})",
            code,
            debug,
        )
    except (
        Exception
    ) as error:  # the last line of defence: a bug must not look like bad data
        return _failed(
            f"internal error: {type(error).__name__}: {error} (run with --debug)",
            BAD_DATA,
            debug,
        )


def _failed(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    with suppress(
        OSError
    ):  # where that cannot be written either, the exit code is all that remains
        print(f"fgtrack: error: {one_line(message)}", file=sys.stderr, flush=True)
    return code


def main() -> int:
    """Run the command line of this process; gives the exit code."""
    os.environ["MPLBACKEND"] = (
        "agg"  # nothing is shown in a window, so none of the system's is needed
    )
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(
            errors="backslashreplace"
        )  # for a letter that the terminal does not have
    return run(sys.argv[1:])
