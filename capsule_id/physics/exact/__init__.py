"""The event-driven engine.

taylor.py  series of a step inside one mode        events.py  the next change of mode on a step
dense.py   samples read off the steps' series      engine.py  the loop over steps, for all lanes at once
"""
