"""Tests of the package and the independent references they compare with."""
