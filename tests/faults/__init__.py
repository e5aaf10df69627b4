"""What becomes of files when a command is killed, or its disk is full or not to be written to."""
