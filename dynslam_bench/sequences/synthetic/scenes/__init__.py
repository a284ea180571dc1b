"""What is rendered: the room, its furniture and textures, and the ways of the camera."""
