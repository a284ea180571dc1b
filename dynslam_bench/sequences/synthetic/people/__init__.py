"""Rendered people: their bodies and what they do."""
