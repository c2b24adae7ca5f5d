"""Numerics without physics: lanes of a batch, and derivatives of what is solved."""
