"""Posterior sampling: ensembles of walkers, their moves, their storage and convergence diagnostics."""
