"""Readers of text tables."""
