"""Segmenters: who finds people and things in a frame (networks, recorded masks, exact masks)."""
