"""The equations with fifty digits."""
