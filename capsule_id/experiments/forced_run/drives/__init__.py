"""Drives of forced runs that are not harmonic: rules of their settings, and the runs themselves."""
