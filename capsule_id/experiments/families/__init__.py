"""What kinds of experiments share with each other."""
