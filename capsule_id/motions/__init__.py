"""Settled motions of the capsule: labels, sweeps, maps and bands over draws of the parameters.

response.py   the settled motion and its label         sweep.py     bifurcation diagrams, maps, basins
operating.py  the same for draws of the parameters     lyapunov.py  the largest Lyapunov exponent
bias.py       the smoothed model against the exact one
"""
