"""The rejection rules of the published systems, one file a rule."""
