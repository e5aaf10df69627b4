"""Types, time, geometry, linear algebra and errors that every other floor uses; imports numpy only."""
