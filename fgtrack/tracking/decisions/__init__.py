"""Decisions of the tracker: which detections belong together, which are clutter, and which objects exist."""
