"""Track several objects from the delayed object lists of several sensors."""

__version__ = "0.1.0"
