"""From foreign messages and data sets to fgtrack's own; the place where other conventions are converted."""
