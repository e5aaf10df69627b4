"""Assumptions about a recording that comes without a configuration: what its own lists show."""
