"""Tables, figures, the HTML page and the files of a result. This package renders; it computes no result.

Import the modules, not the package: ``columns`` is free of matplotlib, xarray and jinja2.
"""
