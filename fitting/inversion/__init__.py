"""Speeds and delay of every impact off amplitude and phase, without a law."""
