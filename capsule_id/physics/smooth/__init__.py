"""The smoothed model: eq. (2) with smoothed Heaviside functions.

march.py  adaptive steps, samples and their derivatives
engine.py the fields, "stick-slip" and "eq2", and the kernel that ``simulate`` calls
"""
