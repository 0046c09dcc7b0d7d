"""Code that several kinds of experiments share."""
