"""Evaluation of runs: truth matching, metrics, tables and figures. Reads run folders, never a tracker."""
