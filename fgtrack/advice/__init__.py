"""Advice on a recording: what is late, wrong or does not fit, and the setting that corrects it."""
