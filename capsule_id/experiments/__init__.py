"""Experiments: a file or a folder per kind with one declaration; ``kind`` makes the experiments of a rig."""
