"""The log-posterior: of all parameters (``log_posterior``), and with the noise levels integrated out (``marginal``)."""
