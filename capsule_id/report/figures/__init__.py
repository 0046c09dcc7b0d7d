"""Figures, a function ``(data, ax) -> ax`` each."""
