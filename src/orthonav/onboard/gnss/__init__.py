"""GNSS monitor: positions of GNSS are compared with those of the map, and never used as ours. Figures
and choices: docs/gnss.md.

`biases`: the difference GNSS minus map, what is constant in it, how that is learnt, and the tests
of a change. `monitor`: one receiver by itself and against the map. `watch`: those of a flight.
"""
