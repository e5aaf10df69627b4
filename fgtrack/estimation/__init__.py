"""Estimators: one object's state from measurements that may arrive late."""
