"""Names of topics."""

import re


def token(name: str) -> str:
    """`name` as a part of a topic name."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)
