"""Column maps of ``rig.toml``: which columns of which files become the columns of an experiment."""
