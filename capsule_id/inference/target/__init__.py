"""Log-posterior of all parameters (``log_posterior``), and with noise levels integrated out (``marginal``)."""
