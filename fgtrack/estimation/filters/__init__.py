"""Recursive filters: the EKF family with replay, backward-forward delay compensation, and their initiation."""
