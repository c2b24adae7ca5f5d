"""Example data that the project makes itself, and the scripts that make it."""
