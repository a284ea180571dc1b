"""DAISY Filter Flow at sparse points: maps, descriptor, matching cost, refinement."""
