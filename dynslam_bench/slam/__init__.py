"""The back end that all trackers share: map, tracking, local mapping, relocalisation. It closes no loops."""
