"""Clock offsets of sensors, estimated from tracks."""
