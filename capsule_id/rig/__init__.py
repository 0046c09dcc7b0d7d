"""What was measured: a folder of tables becomes a ``Rig`` in SI units."""
