"""Tilt of the board until the capsule slips: mu."""
