"""Maps of motions: the command ``bifurcate``, its stores, and measured runs on its figures."""
