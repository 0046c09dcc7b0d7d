"""Checks and tables that several kinds of experiments share, and their interface to a fit."""
