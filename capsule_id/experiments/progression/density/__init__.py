"""Density of the trials of a progression, sessions and outlying trials integrated out, and an emulator of its runs."""
