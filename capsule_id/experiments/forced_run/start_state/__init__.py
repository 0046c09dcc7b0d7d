"""Initial state of a forced run: a rough one from the record, and a better one after a fit."""
