"""A forced run looked at as the paper looks at it: drive, period, contacts, progress, phase plane. Knows no model."""
