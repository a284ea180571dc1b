"""Named benchmark suites, as TOML files."""
