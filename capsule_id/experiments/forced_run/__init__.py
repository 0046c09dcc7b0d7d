"""The capsule driven by the motor, recorded in full motion."""
