"""Checks and tables that several kinds of experiments share, and what a fit offers to them."""
