"""Readers of binary tables: of arrays or sheets with names."""
