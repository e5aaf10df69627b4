"""The published tracker of Karle et al. 2023: its delay compensation, map look-up and defects."""
