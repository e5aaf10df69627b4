"""Types, time, geometry, linear algebra, files and errors: the lowest layer, imported by all others."""
