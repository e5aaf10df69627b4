"""Advice on a recording and a configuration: what is late, wrong or does not fit, and the setting that corrects it."""
