"""The simulator: vehicles on a track or in the open, what sensors see of them, and how late it arrives."""
