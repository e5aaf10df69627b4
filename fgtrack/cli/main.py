"""Entry point: runs a command and turns what went wrong into one line and an exit code."""

import logging
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated

import typer

import fgtrack
from fgtrack.cli import compare, config, convert, demo, figure, info, offsets, replay, simulate, sweep, verify
from fgtrack.core.errors import CallError, FgtrackError

DONE, BAD_DATA, BAD_CALL, INTERRUPTED = 0, 1, 2, 130

app = typer.Typer(
    name="fgtrack",
    help="Track objects from delayed object lists, and compare how delays are dealt with.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


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


app.command()(demo.demo)
app.command()(simulate.simulate)
app.command()(replay.replay)
app.command()(compare.compare)
app.command()(figure.figure)
app.command()(sweep.sweep)
app.command()(verify.verify)
app.command()(info.info)
app.command()(convert.convert)
app.command()(offsets.offsets)
app.command()(config.config)


def run(arguments: Sequence[str]) -> int:
    """Run one command; gives the exit code. Errors are one line on stderr."""
    debug = "--debug" in arguments
    words = [word for word in arguments if word != "--debug"]
    logging.basicConfig(level=logging.WARNING, format="fgtrack: %(message)s", force=True)
    try:
        outcome = typer.main.get_command(app).main(words or ["--help"], prog_name="fgtrack", standalone_mode=False)
        if outcome == INTERRUPTED:  # typer turns the exception into this code
            return _failed("interrupted; what was computed so far is in the output folder", INTERRUPTED, debug)
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
    except Exception as error:  # the last line of defence: a bug must not look like bad data
        return _failed(f"internal error: {type(error).__name__}: {error} (run with --debug)", BAD_DATA, debug)


def _failed(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print("fgtrack: error: " + " ".join(message.split()), file=sys.stderr)
    return code


def main() -> None:
    """Run the command line and exit."""
    sys.exit(run(sys.argv[1:]))
