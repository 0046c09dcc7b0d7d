"""The event-driven engine: series and events of a step, dense output, the loop over steps."""
