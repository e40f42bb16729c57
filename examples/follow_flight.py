"""Track of a flight folder: python examples/follow_flight.py area.onav flight."""

import sys

import orthonav

map_path, flight_path = sys.argv[1:]
flight = orthonav.open_flight(flight_path)
tracker = orthonav.Tracker(orthonav.open_map(map_path))
for seen in flight.views:
    fix = tracker.locate(orthonav.View(seen.grey(), flight.camera, seen.telemetry))
    print(seen.frame, tracker.state.value, fix)
