"""Curves and spectra as instruments store them."""
