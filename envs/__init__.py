"""Gymnasium environments, wrappers and rendering."""
