"""Maximum of the log-posterior: for bench tests (``point_fit``), for bench tests and forced runs (``joint_fit``)."""
