"""What exists in a scene: cantilever, platform, and the container that holds them."""
