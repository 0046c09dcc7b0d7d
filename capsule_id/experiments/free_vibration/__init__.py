"""Free vibration of the rod on a capsule at rest: k1 and c."""
