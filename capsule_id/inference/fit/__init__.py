"""The maximum of the log-posterior: of bench tests (``point_fit``), of bench tests and forced runs (``joint_fit``)."""
