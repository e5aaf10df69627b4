"""The ego vehicle: its pose at any stamp, the growth of its uncertainty, and lists that wait for it."""
