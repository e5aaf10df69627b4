"""What solves the window: a protocol and its implementations on gtsam."""
