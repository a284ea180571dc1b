"""Masks between the network and the filters: schedule, carry, bridging, repair; masks from elsewhere."""
