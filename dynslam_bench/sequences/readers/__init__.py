"""Readers of recorded sequences. A new data set is a ``read_...`` function and a row of `layouts.LAYOUTS`."""
