"""What viewers show of a run: shapes, poses and facts at their two times, and the files that hold them."""
