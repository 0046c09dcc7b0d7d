"""Force of a support spring against its deflection: k2."""
