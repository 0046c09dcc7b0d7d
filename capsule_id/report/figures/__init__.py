"""Figures; a panel is a function ``(data, ax)``."""
