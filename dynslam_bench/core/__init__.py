"""The lowest layer: errors, annotated settings, plug-in discovery, seeding and atomic records."""
