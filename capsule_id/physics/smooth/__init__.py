"""The smoothed model: eq. (2) with smoothed Heaviside functions.

rosenbrock.py  one step        march.py  adaptive steps and samples        march_tangents.py  its derivatives
engine.py      the fields, "stick-slip" and "eq2", and the kernel that ``simulate`` calls
"""
