"""Every knob that trades time for error, from photographs in memory to all test views drawn."""
