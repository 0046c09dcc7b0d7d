"""Detectors of faulty readings: pure functions of arrays, without a model of the rig."""
