"""Experiments simulated with the full scene."""
