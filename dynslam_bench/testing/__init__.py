"""Conformance checks for the authors of plug-ins."""
