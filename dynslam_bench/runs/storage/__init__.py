"""What is kept of runs: records, frames, the store, scores."""
