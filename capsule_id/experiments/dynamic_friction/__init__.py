"""Pushes, speed and distance slid: mu and v_s."""
