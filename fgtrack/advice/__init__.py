"""Advice on a recording: late data, errors, inconsistent noise, and the settings that correct them."""
