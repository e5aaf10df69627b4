"""From a configuration and an input to run folders."""
