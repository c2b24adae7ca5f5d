"""What is measured about scenes and settings: times, errors, effects."""
