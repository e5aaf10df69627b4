import pytest

from fgtrack.core.errors import CallError, DataError, FgtrackError, one_line


@pytest.mark.parametrize("kind", [CallError, DataError, FgtrackError])
def test_an_error_is_one_line_that_a_terminal_can_show(
    kind: type[FgtrackError],
) -> None:
    told = str(
        kind("drive.bag: sensor '\x1b[31mred\x1b]0;title\x07'\nis\t\u202eno\r sensor")
    )
    assert (
        told == "drive.bag: sensor '\\x1b[31mred\\x1b]0;title\\x07' is \\u202eno sensor"
    )
    assert told.isprintable()


def test_of_a_long_error_the_beginning_and_the_end_are_kept() -> None:
    told = str(DataError("drive.bag:7: " + 100_000 * "x" + " is no number: mend it"))
    assert told.startswith("drive.bag:7: xxx")
    assert told.endswith("xxx is no number: mend it")
    assert len(told) < 720


def test_a_line_of_any_script_stays_as_it_is() -> None:
    assert (
        one_line("Fähre.mcap: 船 is no [bold]sensor[/bold]")
        == "Fähre.mcap: 船 is no [bold]sensor[/bold]"
    )


def test_half_a_surrogate_can_be_printed() -> None:
    one_line("name \udce4").encode("utf-8")


def test_a_name_without_end_does_not_hide_the_message() -> None:
    message = str(DataError(f"sensor '{'x' * 5000}' has no model: add a model"))
    assert message.startswith("sensor 'xxx")
    assert message.endswith("' has no model: add a model")
    assert len(message) < 300
    path = f"/{'folder/' * 20}drive.mcap"
    assert one_line(f"{path}: is empty") == f"{path}: is empty"
