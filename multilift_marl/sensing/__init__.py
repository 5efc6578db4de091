"""What drones know: sensors, state estimation, measurement of the payload, communication, detection of a loss."""
