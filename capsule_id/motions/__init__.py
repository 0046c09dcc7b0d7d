"""Settled motions of the capsule: labels, sweeps, maps and bands over draws of the parameters.

response.py   the settled motion and its label             periods.py    contacts and work of single periods
sweep.py      bifurcation diagrams, maps, basins           operating.py  the same for draws of the parameters
points.py, blocks.py, datasets.py                          the points of a sweep, computed in blocks, as a Dataset
attractors.py which motions are one                        lyapunov.py   the largest Lyapunov exponent
bias.py       the smoothed model against the exact one  cluster.py   a Dask cluster for the blocks
"""
