"""Where is this frame? First pose, local map, pose, relocalisation."""
