"""What a real camera makes of an exact image: the noise of depth sensors, the distortion of lenses."""
