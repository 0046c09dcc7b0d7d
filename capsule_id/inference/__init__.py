"""From experiments to a joint posterior, its point fit, its sample and its checks."""
