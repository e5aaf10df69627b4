"""A report of runs: one HTML file with verdict, tables, figures, configuration, and a viewer that plays them."""
