"""A configuration, loaded: names, files, overrides, fragments."""
