"""Checks of a fit; each returns findings."""
