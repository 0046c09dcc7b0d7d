"""The sample: ensembles of walkers, their moves, their store on disk, and what says whether they converged."""
