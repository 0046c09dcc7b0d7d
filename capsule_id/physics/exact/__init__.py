"""The event-driven engine.

taylor.py  series of a step inside one mode        events.py  the next change of mode on a step
friction_series.py  the same for any friction law
dense.py   samples read off the steps' series      engine.py  the loop over steps, for all lanes at once
"""
