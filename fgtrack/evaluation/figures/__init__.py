"""The figures of runs, a module for each thing shown. Drawn without pyplot: nothing is global."""
