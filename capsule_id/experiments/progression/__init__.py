"""Progression: the capsule's displacement after a number of drive periods, a row per trial."""
