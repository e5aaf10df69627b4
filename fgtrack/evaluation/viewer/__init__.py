"""Runs as viewers show them: what is known when, and what it is about."""
