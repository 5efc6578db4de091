"""Configuration: schema, values, files, loading."""
