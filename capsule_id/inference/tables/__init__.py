"""Tables of a fit for the report."""
