"""Clocks of the sensors: arrival of their lists, validity of their stamps, offsets between their clocks."""
