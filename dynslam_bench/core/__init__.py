"""The ground floor: errors, annotated settings, plug-in discovery, seeding and atomic records."""
