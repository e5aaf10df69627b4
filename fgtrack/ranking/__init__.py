"""Ranking of methods for late measurements: scenarios with exact answers, methods of others, and the verdict."""
