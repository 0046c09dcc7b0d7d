"""Model-free analysis of a recorded forced run: drive, period, contacts, mean velocity, phase plane."""
