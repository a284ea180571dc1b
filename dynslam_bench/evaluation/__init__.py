"""Protocol, association, alignment, trajectory errors, coverage and mask quality."""
