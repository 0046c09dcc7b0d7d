"""Fits of one rig folder or of several."""
