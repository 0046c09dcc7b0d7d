"""The smoothed model: eq. (2) with smoothed Heaviside functions.

rosenbrock.py  one step        march.py  adaptive steps and samples        march_tangents.py  its derivatives
friction.py    the stick-slip rule and the force gate        steps.py    smoothed Heaviside functions
engine.py      the fields, "stick-slip" and "eq2", and the kernel that ``simulate`` calls
"""
