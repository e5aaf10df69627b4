"""The published tracker of Karle et al. 2023: its delay compensation, its map, and its defects."""
