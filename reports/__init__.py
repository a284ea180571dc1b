"""Leaderboards and study reports."""
