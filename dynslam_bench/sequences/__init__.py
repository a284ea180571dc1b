"""Frames and sequences: readers, catalogue, download, preprocessing and the synthetic renderer."""
