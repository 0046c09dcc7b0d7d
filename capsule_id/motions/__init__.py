"""Settled motions of the capsule: labels, sweeps, maps and bands over draws of the parameters.

response.py   the settled motion, its label and its largest Lyapunov exponent
sweep.py      bifurcation diagrams, maps, basins, and bands over draws
"""
