"""What may be plugged in: trackers, segmenters, flows, features, filters, sequences, and what they exchange; light."""
