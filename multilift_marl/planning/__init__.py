"""Where the payload is to be: planned trajectories, feasible targets, paths and their files."""
