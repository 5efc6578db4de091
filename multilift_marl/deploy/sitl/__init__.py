"""A whole pipeline in software, from one file: a flight or a simulation, and the nodes that fly it."""
