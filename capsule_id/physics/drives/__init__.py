"""Drives of several pieces.

pulses.py    pulses through a first-order lag        recorded.py  a recorded force, a prescribed motion of the rod
"""
