"""Equations 5 to 8 against automatic differentiation and fifty digits."""
