"""Forced run: the motor drives the capsule, and the full motion is recorded."""
