"""Types, time, geometry, linear algebra, files and errors that every other floor uses."""
