"""Force of the motor against its current: K."""
