"""Tracking several objects: input processing, association, life cycle."""
