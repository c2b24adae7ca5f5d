"""Hard cases, a file a family: why it is hard, a right answer that is independent of the package, values and slopes."""
