"""Bayesian inference: log-posterior, point fit, sample and checks."""
