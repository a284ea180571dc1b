"""What several rejection rules share."""
