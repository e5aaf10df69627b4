"""Likelihood of the innovations of an EKF on recorded tracks, as a function of the noise parameters."""
