"""Factors of standard deviations for the error of a model that fails its checks."""
