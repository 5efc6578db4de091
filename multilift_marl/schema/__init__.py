"""The typed sections of a configuration, kinds of values with their checks, and files that values name."""
