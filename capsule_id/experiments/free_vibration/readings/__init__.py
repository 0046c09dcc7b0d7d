"""Readings of a free decay: block means of long records, and their coloured noise."""
