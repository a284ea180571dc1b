"""The map and what a new keyframe does to it."""
