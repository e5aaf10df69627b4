"""Clocks of sensors: arrivals of lists, validity of stamps, offsets between clocks."""
