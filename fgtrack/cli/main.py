"""Runs a command, and turns an error into one line and an exit code."""

import logging
import os
import resource
import sys
import traceback
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from inspect import cleandoc
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

import fgtrack
from fgtrack.cli.exit_codes import BAD_CALL, BAD_DATA, DONE, INTERRUPTED
from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.core.output import FULL

#: Modules of the commands, in the order of the help; the command is the module's function with its name.
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
    "rank": "rank",
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
    """Imports a command's module when the command is called; the help imports no such module."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _check_once(self, ctx, args)
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: Any, args: list[str]
    ) -> tuple[str | None, Any, list[str]]:
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else _command(name), rest


class _OnceCommand(TyperCommand):
    """Command that refuses an option that is given twice and takes one value; Click would use the last value."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _check_once(self, ctx, args)
        return super().parse_args(ctx, args)


def _check_once(command: Any, ctx: Any, args: list[str]) -> None:
    """Raise `CallError` if `args` give an option of `command` twice that takes one value."""
    _, _, order = command.make_parser(ctx).parse_args(args=list(args))
    for param, count in Counter(order).items():
        takes_one = param.param_type_name == "option" and not param.multiple
        if count > 1 and takes_one and not param.is_flag:
            raise CallError(
                f"{' / '.join(param.opts)}: given {count} times, but the option takes one value"
            )


def _command(name: str) -> Any:  # Any: Typer does not export the type of its commands
    single = typer.Typer(**_STYLE)
    function = getattr(import_module(f"fgtrack.cli.{COMMANDS[name]}"), name)
    single.command(name, cls=_OnceCommand)(function)
    return typer.main.get_command(single)


app = typer.Typer(
    name="fgtrack",
    cls=_LazyCommands,
    help="Track objects from delayed object lists, and compare how delays are dealt with.",
    epilog="Exit codes: 0 done, 1 bad data or run, 2 bad call.",
    **{**_STYLE, "add_completion": True},
)


def _help(name: str) -> str:
    """Docstring of a command, read from the source of its module."""
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
    # Other systems do not enforce this limit.
    if max_memory_gb and sys.platform == "linux":
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        limit = int(max_memory_gb * 2**30)
        resource.setrlimit(
            resource.RLIMIT_AS,
            (limit if most == resource.RLIM_INFINITY else min(limit, most), most),
        )


class _OneLine(logging.Formatter):
    """Formats log messages on one line, because they may contain names from files."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the message of `record` on one line, without control characters."""
        return one_line(super().format(record))


def run(arguments: Sequence[str]) -> int:
    """Run one command and return the exit code; an error is one line on stderr."""
    debug = "--debug" in arguments
    words = [word for word in arguments if word != "--debug"]
    memory = resource.getrlimit(resource.RLIMIT_AS)
    logged = logging.StreamHandler()
    logged.setFormatter(_OneLine("fgtrack: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[logged], force=True)
    # matplotlib warns about system folders that figures do not need.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    logging.captureWarnings(True)
    try:
        return _run(words, debug)
    finally:
        logging.captureWarnings(False)
        # A caller in Python gets its own limit back.
        resource.setrlimit(resource.RLIMIT_AS, memory)


def _run(words: Sequence[str], debug: bool) -> int:
    try:
        outcome = typer.main.get_command(app).main(
            [*words] or ["--help"], prog_name="fgtrack", standalone_mode=False
        )
        if outcome == INTERRUPTED:  # typer turns the exception into this code
            return _failed(
                "interrupted; finished results are in the output folder",
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
            "more memory is needed than --max-memory allows: raise the limit, or split the input",
            BAD_DATA,
            debug,
        )
    except OSError as error:  # for a given path, or for stdout
        code = BAD_DATA if error.errno in FULL else BAD_CALL
        if error.filename is None:
            sys.stdout = None  # otherwise the end of the process would fail on stdout
        return _failed(
            f"{error.filename or 'standard output'}: cannot be used ({error.strerror})",
            code,
            debug,
        )
    except Exception as error:  # a bug must not look like bad data
        return _failed(
            f"internal error: {type(error).__name__}: {error} (run with --debug)",
            BAD_DATA,
            debug,
        )


def _failed(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    # If stderr cannot be written either, only the exit code remains.
    with suppress(OSError):
        print(f"fgtrack: error: {one_line(message)}", file=sys.stderr, flush=True)
    return code


def main() -> int:
    """Run the command line of this process and return the exit code."""
    # Figures are written to files, so no window system is needed.
    os.environ["MPLBACKEND"] = "agg"
    if isinstance(sys.stdout, TextIOWrapper):
        # Characters that the terminal lacks are escaped.
        sys.stdout.reconfigure(errors="backslashreplace")
    return run(sys.argv[1:])
