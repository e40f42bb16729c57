"""Ground that no longer looks like the map: found by the views of a flight, used by `check`."""
