"""The back end that all trackers share: map, tracking, local mapping, relocalisation and loop closing."""
