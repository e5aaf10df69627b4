"""Noise of the motion and of the sensors, fitted to recordings by maximum likelihood."""
