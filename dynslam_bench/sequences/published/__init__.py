"""The public data sets: their sequences, cameras and archives."""
