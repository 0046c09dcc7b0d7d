"""What is shown: tables, figures, one HTML page and the files of a result. Renders only, computes nothing.

Import the modules, not the package: ``text`` is free of matplotlib, xarray and jinja2.
"""
