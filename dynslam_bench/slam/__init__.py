"""The back end that all trackers share: map, tracking, local mapping, loop closing, relocalisation."""
