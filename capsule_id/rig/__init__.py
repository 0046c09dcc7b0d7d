"""Reads what was measured: a rig folder becomes a ``Rig`` in SI units."""
