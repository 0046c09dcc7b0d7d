"""Rig folders that are fitted before and after a large change, and the comparison of both; see ``__main__.py``."""
