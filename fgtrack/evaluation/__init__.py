"""Evaluation of run folders: matching with truth, metrics, comparison and tables. Independent of the tracker."""
