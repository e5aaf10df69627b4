"""Lives of tracks: confirmation and end, by counters or by the probability of existence."""
