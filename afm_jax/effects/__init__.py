"""What each effect of a scene changes and costs."""
