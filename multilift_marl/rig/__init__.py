"""The rig in numbers: vehicles, payload, cables and formation, from a configuration."""
