"""Text in the cells of CSV files, which a spreadsheet must not run as a formula."""

import re

#: A spreadsheet takes a cell with one of these first characters for a formula, or drops the character first.
_FORMULA = re.compile("'*[=+@\t\r-]")


def guarded(text: str) -> str:
    """Return the cell of `text`: an apostrophe stands before everything that a spreadsheet could run.

    Numbers stay as they are. `unguarded` gives the text back.
    """
    return f"'{text}" if _FORMULA.match(text) and not _is_number(text) else text


def unguarded(cell: str) -> str:
    """Return the text of a cell that `guarded` returned."""
    return cell[1:] if cell[:1] == "'" and _FORMULA.match(cell) else cell


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
