"""Checks of forced runs at a fit."""
