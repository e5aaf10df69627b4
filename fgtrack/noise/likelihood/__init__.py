"""Maximum likelihood of noise: the innovations of an EKF on recorded tracks, as a function of standard deviations."""
