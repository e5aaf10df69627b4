"""YAML of strangers."""

import pytest
from ruamel.yaml.error import YAMLError

from fgtrack.core.yaml_text import safe_yaml


@pytest.mark.parametrize(
    "text",
    [
        "{kind: track, [[0.0, 65.5]]}",
        "? {a: 1}\n: b",
        "a: 2001-99-99",
        "a: !!int x",
        "a: !!python/object:os.system {}",
        "<<: 3",
        f"a: {'9' * 5000}",
    ],
)
def test_what_is_no_plain_value_is_an_error_of_yaml_or_a_text(text: str) -> None:
    try:
        value = safe_yaml(text)
    except YAMLError:
        return
    assert isinstance(value, dict)
