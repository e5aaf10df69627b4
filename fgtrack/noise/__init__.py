"""Noise of motion and sensors, fitted to recordings by maximum likelihood."""
