"""GNSS monitor: positions of GNSS are compared with those of the map, and never used as ours.

`biases`: what is constant in GNSS minus map, how that is learnt, and the tests of a change.
`monitor`: one receiver by itself and against the map. `watch`: those of a flight (docs/gnss.md).
"""
