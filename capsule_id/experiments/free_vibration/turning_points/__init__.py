"""Turning points of a free decay, read one by one (``samples = "turning_points"``): likelihood, second fit, checks."""
