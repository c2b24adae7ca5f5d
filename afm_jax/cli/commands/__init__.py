"""The rows of all commands, a file for each group."""
