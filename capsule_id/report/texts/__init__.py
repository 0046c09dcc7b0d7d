"""Texts of findings and captions of tables, by code."""
