"""Tables, figures, the HTML page and the files of a result. This package renders; it computes no result.

Import the modules, not the package: ``console_table`` is free of matplotlib, xarray and jinja2.
"""
