"""Small tables of a fit for the report."""
