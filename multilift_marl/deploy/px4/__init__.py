"""Teams flown by PX4 autopilots in lockstep with the simulation; see docs/flight.md."""
