"""Assumptions about a recording without a configuration, estimated from its own lists."""
