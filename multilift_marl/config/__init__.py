"""Configuration: typed defaults, YAML files, overrides, and the physical system they describe."""

from multilift_marl.config.load import build_config, dump_config, explain, list_configs, load_config, parse_overrides
from multilift_marl.config.schema import Config
from multilift_marl.config.system import System

__all__ = [
    "Config",
    "System",
    "build_config",
    "dump_config",
    "explain",
    "list_configs",
    "load_config",
    "parse_overrides",
]
