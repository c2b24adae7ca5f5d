"""Tapping curves: the energy of a tap, and where the drive allows it the impact law."""
