"""Analyses a recorded forced run without a model: drive, period, contacts, mean velocity, phase plane."""
