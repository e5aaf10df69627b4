"""The simulator: vehicles on a track or in the open, their detections by sensors, and the delays of all messages."""
