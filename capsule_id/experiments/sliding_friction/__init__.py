"""Steady sliding: friction against speed, mu and v_s."""
