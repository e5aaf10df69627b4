"""The process that runs the commands."""

from collections.abc import Iterator

import pytest
from support.server import Server


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.close()
