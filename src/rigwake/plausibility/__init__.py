"""Does a sensor agree with the others? Pure functions that answer with a `SensorCheck`."""
