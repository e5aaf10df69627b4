"""How many examples hypothesis draws where each takes long."""

from hypothesis import settings

few = settings(max_examples=settings().max_examples // 3)
